"""What the neighbours of a return in its scan tell."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from triquad_format.records.arrays import Bools, Doubles
from triquad_map.evidence.neighbours import ask_neighbours

SPACING = 2 * np.pi / 512
"""The angle between the rays of :func:`lidar`, radians."""


def lidar() -> Doubles:
    """Return directions [N, 3] of rays that are spread evenly, a band of 0.4 rad around."""
    azimuth, elevation = np.arange(-np.pi, np.pi, SPACING), np.arange(-0.2, 0.2, SPACING)
    a, e = (each.ravel() for each in np.meshgrid(azimuth, elevation))
    return np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], 1)


def have_company(rays: Doubles) -> Bools:
    """Return which of all rays have company."""
    return ask_neighbours(rays, np.arange(len(rays))).have_company


def by_all_pairs(rays: Doubles, angles: Doubles) -> Bools:
    """Return [angles, N] which ends two neighbours meet, or two in five of them no farther."""
    ranges = np.linalg.norm(rays, axis=1)
    directions = rays / ranges[:, None]
    apart = np.linalg.norm(directions[:, None] - directions, axis=2)
    np.fill_diagonal(apart, np.inf)
    farther = ranges - ranges[:, None]
    found = []
    for angle in angles:
        near = apart <= angle
        same = (near & (np.abs(farther) <= 1)).sum(axis=1)
        no_farther = (near & (farther <= 1)).sum(axis=1)
        is_among = (no_farther >= 2) & (no_farther >= 0.4 * near.sum(axis=1))
        found.append((same >= 2) | is_among)
    return np.array(found)


@pytest.mark.parametrize("range_voxels", [5.0, 50.0, 500.0])
def test_a_wall_has_company_however_far(range_voxels: float) -> None:
    assert have_company(range_voxels * lidar()).all()


@pytest.mark.parametrize("range_voxels", [50.0, 500.0])
def test_a_single_return_before_a_wall_has_none(range_voxels: float) -> None:
    rays = range_voxels * lidar()
    drops = np.arange(0, len(rays), 997)
    rays[drops] *= 0.6
    np.testing.assert_array_equal(np.flatnonzero(~have_company(rays)), drops)


def test_two_returns_near_each_other_are_not_enough_and_three_are() -> None:
    rays = 100 * lidar()
    middle = len(rays) // 2
    rays[middle : middle + 2] *= 0.5
    assert np.flatnonzero(~have_company(rays)).tolist() == [middle, middle + 1]
    rays[middle + 2] *= 0.5
    assert have_company(rays).all()


def test_no_ray_or_one_has_no_company() -> None:
    assert have_company(np.empty((0, 3))).tolist() == []
    assert have_company(np.array([[3.0, 4, 5]])).tolist() == [False]
    assert have_company(np.zeros((1, 3))).tolist() == [False]


def test_what_lies_behind_its_neighbours_has_company_and_what_hangs_before_them_has_none() -> None:
    rays = 100 * lidar()
    middle = len(rays) // 2
    rays[middle] *= 1.5
    assert have_company(rays).all()  # seen through a gap: no drop is there
    rays[middle] *= 0.5
    assert np.flatnonzero(~have_company(rays)).tolist() == [middle]


def test_ground_has_company_where_it_is_grazed() -> None:
    """There, neighbours end voxels nearer and farther."""
    down = lidar()[lidar()[:, 2] < -0.02]
    rays = down * (-9 / down[:, 2:])
    assert have_company(rays)[down[:, 2] > -0.18].mean() > 0.99


def test_drops_near_the_sensor_have_none_though_they_are_near_each_other() -> None:
    rays = 100 * lidar()
    drops = np.arange(0, len(rays), 40)
    rays[drops] *= 0.02
    assert not have_company(rays)[drops].any()


def test_a_great_many_rays_in_one_direction_take_no_longer_than_others() -> None:
    """As of a cloud that is kilometres away from where its rays are said to begin."""
    ranges = np.linspace(1.0, 1e7, 300_000)
    assert have_company(ranges[:, None] * [0.6, 0.8, 0.0]).any()  # each with each: hours


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), furthest=st.sampled_from([1.5, 20.0, 300.0]))
def test_it_is_what_all_pairs_tell(seed: int, furthest: float) -> None:
    """But where the angle counts, which is told by how the rays are spread."""
    rng = np.random.default_rng(seed)
    directions = rng.permutation(lidar())[:1500]
    rays = directions * furthest ** rng.random((len(directions), 1))
    spacing = np.sqrt(2 * np.pi * 0.4 / len(rays))
    slow = by_all_pairs(rays, np.linspace(2.6, 3.6, 60) * spacing)
    sure = (slow == slow[0]).all(axis=0)
    assert sure.mean() > 0.2
    np.testing.assert_array_equal(have_company(rays)[sure], slow[0][sure])


def extent_of(rays: Doubles, ray: int) -> Doubles:
    """Return the covariance [3, 3] of the surface on which a ray ends."""
    xx, xy, xz, yy, yz, zz = ask_neighbours(rays, np.array([ray])).extents[0]
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def test_a_wall_extends_all_over_the_voxel_and_not_along_the_ray() -> None:
    rays = 50 * lidar()
    middle = len(rays) // 2 - 10
    along = rays[middle] / 50
    extent = extent_of(rays, middle)
    assert along @ extent @ along < 0.001
    across = np.linalg.eigvalsh(extent)[1:]
    np.testing.assert_allclose(across, 1 / 12, rtol=0.3)  # what fills a voxel has 1/12 on an axis


def test_a_post_extends_upwards_alone() -> None:
    rays = 100 * lidar()
    azimuth = np.arctan2(rays[:, 1], rays[:, 0])
    post = np.flatnonzero(np.abs(azimuth - 0.5) < 0.6 * SPACING)
    rays[post] *= 0.5
    extent = extent_of(rays, int(post[len(post) // 2]))
    assert extent[2, 2] > 0.1
    assert np.trace(extent) - extent[2, 2] < 0.02


def test_a_drop_may_be_anywhere_in_its_voxel() -> None:
    rays = 100 * lidar()
    rays[1000] *= 0.5
    np.testing.assert_allclose(extent_of(rays, 1000), np.eye(3) / 12)
