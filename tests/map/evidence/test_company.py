"""Which returns of a scan have others beside them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from triquad_format.records.arrays import Bools, Doubles
from triquad_map.evidence.company import have_company

SPACING = 2 * np.pi / 512
"""The angle between the rays of :func:`lidar`, radians."""


def lidar() -> Doubles:
    """Return directions [N, 3] of rays that are spread evenly, a band of 0.4 rad around."""
    azimuth, elevation = np.arange(-np.pi, np.pi, SPACING), np.arange(-0.2, 0.2, SPACING)
    a, e = (each.ravel() for each in np.meshgrid(azimuth, elevation))
    return np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], 1)


def by_a_tree(rays: Doubles, angle: float) -> Bools:
    """Return which ends [N, 3] have two others within ``angle`` of their range, or a voxel."""
    radii = np.maximum(angle * np.linalg.norm(rays, axis=1), 1.0)
    return np.asarray(cKDTree(rays).query_ball_point(rays, radii, return_length=True)) > 2


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


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), furthest=st.sampled_from([1.5, 20.0, 300.0]))
def test_it_is_what_a_tree_finds(seed: int, furthest: float) -> None:
    """But near the angle that counts, which is told by how the rays are spread."""
    rng = np.random.default_rng(seed)
    directions = lidar()
    rays = directions * furthest ** rng.random((len(directions), 1))
    found = have_company(rays)
    assert (by_a_tree(rays, 2.5 * SPACING) <= found).all()
    assert (found <= by_a_tree(rays, 3.6 * SPACING)).all()
