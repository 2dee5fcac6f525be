"""What has just appeared is known at once: after one scan, before the field has learnt it."""

from functools import cache

import numpy as np
import pytest
from support.maps.small_world import WALLED, WALLED_BOUNDS, settings, settle
from support.poses import shifted
from triquad_format.records.arrays import Doubles
from triquad_format.records.region import MapRecord
from triquad_format.records.status import Status
from triquad_map.questions.bodies import segments, spheres
from triquad_map.questions.distance import distances
from triquad_map.questions.ground import ground
from triquad_map.questions.rays import rays
from triquad_server.epochs.epoch import Epoch
from triquad_server.mapping.mapper import Mapper
from triquad_tools.simulation.lidar import Lidar
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import Solid, box

VOXEL_M = 0.2
NEW = {
    "wall": box((4.1, 0.0, 0.5), (0.15, 3.0, 0.5)),
    "slab": box((2.5, 0.0, 0.125), (1.0, 1.0, 0.125)),
    "box": box((3.0, 0.5, 0.45), (0.5, 0.6, 0.45)),
}


LIDAR = Lidar(columns=1024, elevation_min_deg=-45.0)
CHOSEN = settings(samples_per_ray=6.0)


def pose_of(number: int) -> Doubles:
    return shifted(0.1 * number - 1.0, 0.1, 1.4)


@cache
def empty_place() -> MapRecord:
    """What a map has learnt of the place."""
    mapper = Mapper("test", CHOSEN, "cpu")
    for number in range(8):
        pose, rng = pose_of(number), np.random.default_rng(number)
        scan = LIDAR.scan(Scene(WALLED, WALLED_BOUNDS), pose, rng)
        mapper.ingest(scan.points, pose, stamp_s=number)
    settle(mapper)
    return mapper.snapshot_since(None).record()


class Seen:
    """A map of an empty place in which something has just been seen, by one scan or a few."""

    def __init__(self, solid: Solid, steps: int, scans: int = 1) -> None:
        mapper = Mapper("test", CHOSEN, "cpu", empty_place())
        mapper.publish()
        pose = pose_of(7)
        self.scene = Scene((*WALLED, solid), WALLED_BOUNDS)
        for number in range(8, 8 + scans):
            scan = LIDAR.scan(self.scene, pose, np.random.default_rng(91 + number))
            mapper.ingest(scan.points, pose, stamp_s=number)
            mapper.publish()
        for _ in range(steps):
            mapper.train()
        self.epoch: Epoch = mapper.publish()
        on_it = np.abs(Scene((solid,), WALLED_BOUNDS).sdf(scan.true_hits)) < 1e-3
        # The lowest voxels are those of the floor, too, and have one surfel.
        self.hits: Doubles = scan.true_hits[on_it & (scan.true_hits[:, 2] > VOXEL_M)]
        self.normals: Doubles = self.scene.gradient(self.hits)


@pytest.fixture(scope="module", params=[(n, s) for n in NEW for s in (0, 3)], ids=str)
def seen(request: pytest.FixtureRequest) -> Seen:
    name, steps = request.param
    return Seen(NEW[name], steps)


def test_segments_through_it_are_blocked(seen: Seen) -> None:
    starts, ends = seen.hits + 0.5 * seen.normals, seen.hits - 0.15 * seen.normals
    for radius_m, least in ((0.0, 0.9), (0.1, 0.99)):
        found = segments(seen.epoch, starts, ends, radius_m, 1.0)
        assert found.blocked.mean() > least


def test_rays_end_on_it(seen: Seen) -> None:
    found = rays(seen.epoch, seen.hits + 0.5 * seen.normals, -seen.normals, 2.0, True)
    assert (found.status == Status.SURFACE).mean() > 0.97
    assert (np.abs(found.range_m - 0.5) < VOXEL_M / 2).mean() > 0.9


def test_balls_at_it_meet_it(seen: Seen) -> None:
    found = spheres(
        seen.epoch, seen.hits + 0.05 * seen.normals, np.full(len(seen.hits), VOXEL_M / 2)
    )
    assert (found.status == Status.SURFACE).mean() > 0.99


def test_distances_are_right_within_half_a_voxel(seen: Seen) -> None:
    for height_m in (0.0, 0.05, 0.1, 0.3, 0.6):
        points = seen.hits + height_m * seen.normals
        found = distances(seen.epoch, points, 2.0)
        error_m = np.abs(found.distance_m - seen.scene.sdf(points))
        assert (error_m < VOXEL_M / 2).mean() > 0.98
        assert np.median(error_m) < 0.02


def test_close_behind_it_distances_are_negative(seen: Seen) -> None:
    behind = distances(seen.epoch, seen.hits - 0.04 * seen.normals, 2.0)
    assert (behind.distance_m < 0).mean() > 0.85
    towards = (behind.gradient * seen.normals).sum(axis=1)
    assert np.median(towards) > 0.98


def test_its_top_bears_and_never_what_lies_below(seen: Seen) -> None:
    tops = seen.hits[seen.normals[:, 2] > 0.9]
    found = ground(seen.epoch, tops + (0, 0, 0.5), 2.0)
    stands = found.status == Status.SURFACE
    assert stands.mean() > 0.8
    assert (np.abs(found.height_m - tops[:, 2])[stands] < VOXEL_M / 2).mean() > 0.95
    assert (found.height_m > 0.05).all()


def test_what_is_not_trained_on_is_known_as_well_after_many_scans() -> None:
    once, often = (Seen(NEW["box"], steps=0, scans=scans) for scans in (1, 15))
    errors_m = []
    for seen in (once, often):
        points = once.hits + 0.1 * once.normals
        found = distances(seen.epoch, points, 2.0)
        errors_m.append(np.abs(found.distance_m - once.scene.sdf(points)))
    assert np.median(errors_m[1]) < 0.01
    assert np.quantile(errors_m[1], 0.9) < 1.2 * np.quantile(errors_m[0], 0.9)
