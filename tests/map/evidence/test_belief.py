"""Surface that rays contradict is taken back; what is only missed at times stays."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.maps.watched_evidence import SENSOR, SIDE, Watched
from triquad_format.records.arrays import Doubles
from triquad_format.records.region import seen_voxels
from triquad_format.records.status import Status
from triquad_map.evidence.evidence import outcome_counts
from triquad_map.evidence.live_evidence import LiveEvidence
from triquad_map.evidence.observed import Sighting, first_seen_since
from triquad_map.surface import SurfelKind, nothing_shown

WALL_X = 60.5


def panel(rng: np.random.Generator, x: float, half: float = 8.0, count: int = 1500) -> Doubles:
    """Random points on a square that faces the sensor."""
    y, z = SENSOR[1:, None] + rng.uniform(-half, half, (2, count))
    return np.stack([np.full(count, x), y, z], 1)


def behind(ends: Doubles, x: float) -> Doubles:
    """Where rays to ``ends`` arrive that go on to a plane at ``x``."""
    return SENSOR + (ends - SENSOR) * ((x - SENSOR[0]) / (ends[:, :1] - SENSOR[0]))


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def test_one_scan_with_a_wrong_pose_takes_no_wall_away(rng: np.random.Generator) -> None:
    for scans in (2, 10):
        watched = Watched()
        for _ in range(scans):
            watched.scan(panel(rng, WALL_X))
        before = watched.believed(panel(rng, WALL_X, half=7.0))
        assert before > 0.95
        watched.scan(behind(panel(rng, WALL_X), 120.0))
        assert watched.believed(panel(rng, WALL_X, half=7.0)) > before - 0.02
        for _ in range(8):
            watched.scan(behind(panel(rng, WALL_X), 120.0))
        assert watched.believed(panel(rng, WALL_X, half=7.0)) < 0.02


def test_a_ray_beside_the_only_hit_contradicts_what_extends_to_it() -> None:
    y, z = (at.ravel() for at in np.meshgrid(np.arange(-8.0, 9.0), np.arange(-8.0, 9.0)))
    face = SENSOR + np.stack([np.full(len(y), 40.2), y, z], 1)
    before_others = np.where(y[:, None] == 0, 1.0, 2.5)  # one column of rays ends on a post
    left = {}
    for name, ends in (("face", face), ("post", SENSOR + before_others * (face - SENSOR))):
        thing = ends[ends[:, 0] == face[:, 0]]
        watched = Watched()
        watched.scan(ends)
        assert watched.believed(thing) == 1.0
        for _ in range(6):
            watched.scan(SENSOR + 2.5 * (thing + [0.0, 0.35, 0.0] - SENSOR))
        left[name] = watched.believed(thing)
    assert left["face"] < 0.1
    assert left["post"] > 0.9


def test_a_wall_that_rays_reach_stays_for_ever(rng: np.random.Generator) -> None:
    watched = Watched()
    for _ in range(100):
        assert watched.scan(panel(rng, WALL_X + rng.normal(0, 0.05))) == 0


def test_a_wall_that_rays_pass_goes_and_comes_back_each_time(
    rng: np.random.Generator,
) -> None:
    watched = Watched()
    wall = panel(rng, WALL_X, half=7.0)
    for _ in range(3):
        for _ in range(10):
            watched.scan(panel(rng, WALL_X))
        assert watched.believed(wall) == 1.0
        for _ in range(10):
            watched.scan(behind(panel(rng, WALL_X), 120.0))
        assert watched.believed(wall) < 0.02
    status = watched.evidence.freeze().status(wall, reach=0.0)
    assert (status == Status.FREE).mean() > 0.97


def test_surface_is_new_for_some_scans_and_again_where_it_comes_back(
    rng: np.random.Generator,
) -> None:
    watched, wall = Watched(), panel(rng, WALL_X)

    def are_new() -> bool:
        watched.scans += 1
        sighting = Sighting(SENSOR, 0.2, watched.scans, scan=watched.scans)
        rows = watched.evidence.record_ends(wall[:5], sighting)
        watched.evidence.mark("surface", wall[:5])
        return bool(first_seen_since(watched.scans - 2, rows, watched.evidence.observed).all())

    assert [are_new() for _ in range(5)] == [True, True, True, False, False]
    while watched.believed(wall[:5]) > 0:
        watched.scan(behind(wall, 200.5))
    assert [are_new() for _ in range(5)] == [True, True, True, False, False]


def test_ground_is_not_taken_back_by_rays_that_graze_it(rng: np.random.Generator) -> None:
    watched = Watched()
    ground_z, first = SENSOR[2] - 8.3, None
    for _ in range(60):
        x = SENSOR[0] + rng.uniform(10, 200, 4000)
        y = SENSOR[1] + rng.uniform(-10, 10, 4000)
        z = ground_z + rng.normal(0, 0.05, 4000)
        ends = np.stack([x, y, z], 1)
        first = ends if first is None else first
        watched.scan(ends)
    assert first is not None
    assert watched.believed(first) > 0.998


@settings(max_examples=10)
@given(share=st.floats(0.15, 0.9), seed=st.integers(0, 1000))
def test_what_is_hit_and_missed_by_turns_stays(share: float, seed: int) -> None:
    """A fence: of the rays to a voxel, this share ends there, and the others go on."""
    rng, watched = np.random.default_rng(seed), Watched()
    for _ in range(120):
        ends = panel(rng, WALL_X, half=4.0, count=400)
        through = rng.random(len(ends)) > share
        ends[through] = behind(ends[through], 120.0)
        watched.scan(ends)
    assert watched.believed(panel(rng, WALL_X, half=3.0)) > 0.95


def test_a_record_keeps_what_became_of_rays(rng: np.random.Generator) -> None:
    watched = Watched()
    for _ in range(60):
        ends = panel(rng, WALL_X, half=4.0, count=400)
        through = (rng.random(len(ends)) > 0.3) & (ends[:, 1] > SENSOR[1])  # a wall beside a fence
        ends[through] = behind(ends[through], 120.0)
        watched.scan(ends)
    record = watched.evidence.record()
    assert record.outcomes is not None
    voxels = seen_voxels(record, record.surface)
    at_panel = voxels[:, 0] == int(WALL_X)
    fence, wall = (side & at_panel for side in (voxels[:, 1] > 129, voxels[:, 1] < 128))
    hits, _, misses = outcome_counts(record.outcomes).T
    assert np.median(hits[fence]) >= 4
    assert np.median(hits[wall]) == 8
    # Of a scan six rays reach a voxel of the fence, and four of them go on.
    assert 0.5 <= np.median(misses[fence] / hits[fence]) <= 4
    assert not np.median(misses[wall])
    again = LiveEvidence.from_record(SIDE, record).record()
    np.testing.assert_array_equal(again.outcomes, record.outcomes)


def test_what_noise_spread_over_two_voxels_goes_as_well_after_a_restart(
    rng: np.random.Generator,
) -> None:
    watched, x = Watched(), 59.95

    def noisy() -> Doubles:
        return panel(rng, x) + rng.uniform(-0.15, 0.15, (1500, 1)) * (1, 0, 0)

    for _ in range(8):
        watched.scan(noisy())
    record = watched.evidence.record()
    watched.evidence = LiveEvidence.from_record(SIDE, record)
    voxels = seen_voxels(record, record.surface)
    shown = nothing_shown(voxels)  # but the field shows the wall where it was
    at_wall = voxels[:, 0] == 59
    shown.kinds[at_wall], shown.normals[at_wall] = SurfelKind.DISC, (-1, 0, 0)
    shown.offsets[at_wall, 0] = x - 59.5
    watched.evidence.set_discs(voxels, shown)
    middle = np.abs(voxels[:, 1:] + 0.5 - SENSOR[1:]).max(axis=1) < 6
    spread = voxels[middle & (voxels[:, 0] == 60)]
    gone, standing = (spread[spread[:, 2] % 2 == odd] for odd in (1, 0))
    assert watched.believed(spread) == 1
    for _ in range(20):
        ends = noisy()
        through = ends[:, 2].astype(np.int64) % 2 == 1  # every second row of voxels
        ends[through] = behind(ends[through], 120.0)
        watched.scan(ends)
    assert watched.believed(gone) < 0.05
    assert watched.believed(standing) == 1


def test_nothing_goes_while_no_ray_passes(rng: np.random.Generator) -> None:
    watched = Watched()
    watched.scan(panel(rng, WALL_X))
    elsewhere = SENSOR + rng.uniform(-1, 1, (500, 3)) * (0, 30, 30) - (15, 0, 0)
    for _ in range(200):
        assert watched.scan(elsewhere) == 0


def lattice(rng: np.random.Generator, x: float, rows: Doubles) -> Doubles:
    """Where rays as far apart as those of a lidar meet a thing at ``x``: one end for each ray."""
    y, z = np.meshgrid(np.arange(-4.5, 4.5, 0.7), rows, indexing="ij")
    y = y.ravel() + rng.uniform(-0.3, 0.3)
    return np.stack([np.full(y.size, x), SENSOR[1] + y, SENSOR[2] + z.ravel()], 1)


def test_what_is_beside_a_far_thing_that_went_goes_with_it() -> None:
    """The back of a car, seen once: below rays reach the road behind it, above it is open sky.

    How many rays pass a voxel by chance differs from drive to drive.
    """
    left = []
    for drive in range(10):
        rng, watched = np.random.default_rng(drive), Watched()
        high, low = np.array([1.5]), np.array([-3.0, -1.5, 0.0])
        back = lattice(rng, 180.5, np.concatenate([low, high]))
        watched.scan(back)
        assert watched.believed(back) == 1.0
        for _ in range(10):
            watched.scan(behind(lattice(rng, 180.5, low), 240.0))
        left.append(watched.believed(back))
    assert np.mean(left) < 0.06
    assert np.max(left) < 0.2


def test_a_wall_stays_where_rays_go_along_it(rng: np.random.Generator) -> None:
    """Seen once at a grazing angle; later rays miss it narrowly, and pass its voxels."""
    watched = Watched()
    x, z = np.meshgrid(np.arange(100.0, 140.0, 0.9), np.arange(-4.0, 4.0, 0.8))
    wall = np.stack([x.ravel(), np.full(x.size, SENSOR[1] + 5.55), SENSOR[2] + z.ravel()], 1)
    watched.scan(wall)
    sensor = SENSOR + [0.0, 4.9, 0.0]
    for _ in range(5):
        y, z = SENSOR[1] + rng.uniform(4.9, 5.4, 300), SENSOR[2] + rng.uniform(-6, 6, 300)
        watched.scan(np.stack([np.full(300, 200.0), y, z], 1), sensor=sensor)
    assert watched.believed(wall) > 0.99


def test_a_single_return_in_mid_air_is_no_surface_until_it_is_met_again() -> None:
    watched, at = Watched(), np.array([[60.5, 128.5, 128.5]])
    watched.scan(at)
    assert watched.believed(at) == 0
    assert watched.evidence.freeze().status(at, reach=0.0) == 0, "nor is it free"
    watched.scan(at)
    assert watched.believed(at) == 1


def test_what_stands_is_surface_at_the_first_scan(rng: np.random.Generator) -> None:
    watched, wall = Watched(), panel(rng, WALL_X)
    watched.scan(wall)
    assert watched.believed(wall) > 0.99


def test_drops_of_rain_are_no_surface(rng: np.random.Generator) -> None:
    """Before a wall, a return of a hundred comes from a drop; all of them fall elsewhere."""
    watched, drops = Watched(), []
    for _ in range(40):
        ends = panel(rng, WALL_X, count=3000)
        wet = rng.random(len(ends)) < 0.01
        ends[wet] = SENSOR + (ends[wet] - SENSOR) * rng.uniform(0.2, 0.9, (int(wet.sum()), 1))
        drops.append(ends[wet])
        watched.scan(ends)
    assert watched.believed(np.concatenate(drops)) < 0.02
    assert watched.believed(panel(rng, WALL_X, half=7.0)) > 0.99


def test_the_ground_does_not_hold_what_stood_on_it(rng: np.random.Generator) -> None:
    """A low box goes; the ground before it and where it stood is met by every scan."""
    watched = Watched()
    ground_z, front_x = SENSOR[2] - 8.9, 60.5

    def ground(last_x: float) -> Doubles:
        x, y = rng.uniform(40, last_x, 6000), SENSOR[1] + rng.uniform(-8, 8, 6000)
        return np.stack([x, y, ground_z + rng.normal(0, 0.05, 6000)], 1)

    def front(count: int) -> Doubles:
        y, z = SENSOR[1] + rng.uniform(-4, 4, count), rng.uniform(120, 122, count)
        return np.stack([np.full(count, front_x), y, z], 1)

    for _ in range(5):
        watched.scan(np.concatenate([ground(front_x), front(400)]))
    assert watched.believed(front(400)) > 0.99
    for _ in range(10):
        watched.scan(ground(90.0))
    assert watched.believed(front(400)) < 0.02
