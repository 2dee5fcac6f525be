"""Within a voxel, a surface ends where the last rays ended, unless it goes on beside it."""

from typing import NamedTuple

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from support.maps.seen_scans import end, see
from triquad_format.records.arrays import Bools, Doubles
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import Evidence, seen_voxels
from triquad_map.evidence.carving import Reach
from triquad_map.evidence.evidence import FrozenEvidence
from triquad_map.evidence.live_evidence import LiveEvidence
from triquad_map.evidence.observed import Sighting
from triquad_map.surface import MARGIN_STEP

SETTINGS = FieldSettings(depth=8)
SIDE = 1 << SETTINGS.depth
REACH = 0.1
MANY = 10  # scans
AGAIN = Sighting(np.zeros(3), 0.2, 2, scan=MANY + 1)


class Wall(NamedTuple):
    """A wall at ``x = 20.5`` voxels, between two corners (y, z)."""

    low: tuple[float, float]
    high: tuple[float, float]

    def points(self, rng: np.random.Generator, count: int = 4000) -> Doubles:
        y, z = rng.uniform(self.low, self.high, (count, 2)).T
        return np.stack([np.full(count, 20.5), y, z], axis=1)


def seen(ends: Doubles, scans: int = MANY) -> LiveEvidence:
    """Evidence of rays that ended there, in each of so many scans."""
    evidence = LiveEvidence(SIDE)
    for number in range(1, scans + 1):
        see(evidence, ends, Sighting(np.zeros(3), 0.2, 1, scan=number))
    return evidence


def near(evidence: LiveEvidence, points: Doubles) -> Bools:
    return evidence.freeze().near_ends(points, REACH)


def random_ends(seed: int, count: int) -> Doubles:
    """Around a few places, so that voxels have neighbours and several ends; some are outside."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-1, SIDE + 1, (3, 3))
    return places[rng.integers(3, size=count)] + rng.normal(0, rng.uniform(0.1, 2), (count, 3))


def test_a_wall_ends_where_the_last_rays_did() -> None:
    rng = np.random.default_rng(1)
    wall = Wall((10.4, 30.0), (17.3, 34.0))
    evidence = seen(wall.points(rng))
    assert near(evidence, wall.points(rng)).all()
    assert not near(evidence, Wall((10.0, 30.0), (10.2, 34.0)).points(rng)).any()
    assert not near(evidence, Wall((17.6, 30.0), (18.0, 34.0)).points(rng)).any()


def test_of_what_few_scans_saw_nothing_is_left_out() -> None:
    """They may have missed it; as soon as a voxel beside was hit often, they would not have."""
    rng = np.random.default_rng(6)
    wall, rest = Wall((10.4, 30.0), (17.3, 34.0)), Wall((17.7, 30.0), (18.0, 34.0))
    evidence = seen(wall.points(rng), scans=1)
    assert near(evidence, rest.points(rng)).all()
    beside = Wall((16.0, 30.0), (17.0, 34.0))
    for number in range(2, MANY):
        see(evidence, beside.points(rng), Sighting(np.zeros(3), 0.2, 2, scan=number))
    assert not near(evidence, rest.points(rng)).any()
    assert near(evidence, Wall((10.0, 30.0), (10.1, 34.0)).points(rng)).all()


def test_it_goes_on_between_rays() -> None:
    """Two lines of rays a voxel apart: nothing is missing between them, whatever rays there are."""
    rng = np.random.default_rng(2)
    lines = [Wall((10.0, z), (17.0, z + 0.1)).points(rng) for z in (30.2, 31.9)]
    evidence = seen(np.concatenate(lines))
    assert near(evidence, Wall((10.0, 30.2), (17.0, 32.0)).points(rng)).all()
    assert not near(evidence, Wall((10.0, 32.6), (17.0, 33.0)).points(rng)).any()


def slowly_near_ends(record: Evidence, points: Doubles, reach: float) -> Bools:
    voxels = seen_voxels(record, record.surface)[:, None]  # [S, 1, 3]
    low, high = np.floor(points - reach), np.floor(points + reach)
    depths = np.concatenate([points - voxels, voxels + 1 - points], axis=2)  # [S, N, 6]
    in_margin = (record.margins > 0)[:, None] & (depths < MARGIN_STEP * record.margins[:, None])
    near = ((voxels >= low) & (voxels <= high)).all(axis=2) & ~in_margin.any(axis=2)
    return np.asarray(near.any(axis=0))


@settings(max_examples=100)
@given(
    seed=st.integers(0, 10_000),
    count=st.integers(0, 200),
    scans=st.integers(1, MANY),
    reach=st.floats(0, 1.5),
)
def test_all_ways_to_ask_agree(seed: int, count: int, scans: int, reach: float) -> None:
    """As the server asks, as from a file, and where each point is compared with each voxel."""
    ends = random_ends(seed, count)
    rng = np.random.default_rng(seed)
    points = random_ends(seed, 500) + rng.normal(0, 0.3, (500, 3))
    frozen = seen(ends, scans).freeze()
    record = frozen.record()
    have = frozen.near_ends(points, reach)
    np.testing.assert_array_equal(
        FrozenEvidence.from_record(SIDE, record).near_ends(points, reach), have
    )
    np.testing.assert_array_equal(slowly_near_ends(record, points, reach), have)
    is_surface = frozen.status(points, reach) == 2
    assert is_surface[have].all()


@settings(max_examples=100)
@given(
    seed=st.integers(0, 10_000),
    count=st.integers(0, 200),
    step=st.sampled_from([0.25, 0.5, 1.0, 1.7]),
    reach=st.sampled_from([0.0, 0.25, 0.35, 1.0]),
)
def test_a_grid_has_surface_where_its_points_have(
    seed: int, count: int, step: float, reach: float
) -> None:
    ends = random_ends(seed, count)
    rng = np.random.default_rng(seed)
    first = random_ends(seed, 1)[0] - rng.uniform(0, 20, 3) * step
    axes = [low + step * np.arange(rng.integers(30)) for low in np.round(4 * first) / 4]
    frozen = seen(ends, 1).freeze()
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    expected = frozen.status(points.reshape(-1, 3), reach).reshape(points.shape[:-1]) == 2
    np.testing.assert_array_equal(frozen.surface_in_grid(axes, reach), expected)


@settings(max_examples=50)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 200), scans=st.integers(1, MANY))
def test_margins_outlast_a_restart(seed: int, count: int, scans: int) -> None:
    ends = random_ends(seed, count)
    record = seen(ends, scans).record()
    restored = LiveEvidence.from_record(SIDE, record)
    np.testing.assert_array_equal(restored.record().margins, record.margins)
    see(restored, ends, AGAIN)  # nothing is known to be wider
    np.testing.assert_array_equal(restored.record().margins, record.margins)


def test_new_rays_widen_what_was_seen_before_a_restart() -> None:
    rng = np.random.default_rng(3)
    wall, more = Wall((10.0, 30.0), (17.2, 34.0)), Wall((17.1, 30.0), (17.8, 34.0))
    restored = LiveEvidence.from_record(SIDE, seen(wall.points(rng)).record())
    assert not near(restored, Wall((17.5, 30.1), (17.8, 33.9)).points(rng)).any()
    see(restored, more.points(rng), AGAIN)
    assert near(restored, wall.points(rng)).all()
    assert near(restored, more.points(rng)).all()


def test_what_was_taken_back_is_forgotten() -> None:
    """A wall goes, and a narrower one comes: it ends where the narrower one does."""
    rng = np.random.default_rng(4)
    sensor, evidence = np.array([5.3, 14.1, 32.2]), LiveEvidence(SIDE)
    wide, narrow = Wall((11.0, 30.0), (16.8, 34.0)), Wall((11.0, 30.0), (16.2, 34.0))

    def scan(number: int, ends: Doubles) -> None:
        rows = end(evidence, ends, Sighting(sensor, 0.2, number, scan=number))
        passed = evidence.carve(sensor, ends, Reach(0.5, 2.5, number))
        evidence.believe(rows, passed)

    for number in range(1, 11):
        scan(number, wide.points(rng))
    for number in range(11, 31):
        ends = wide.points(rng)
        scan(number, sensor + (ends - sensor) * 4)
    assert not near(evidence, wide.points(rng)).any()
    alone = np.array([[20.5, 14.05, 32.5]])  # a single ray may have missed the rest
    see(evidence, alone, Sighting(sensor, 0.2, 31, scan=31))
    assert near(evidence, np.array([[20.5, 14.9, 32.5]])).all()
    for number in range(32, 41):
        scan(number, narrow.points(rng))
    assert near(evidence, narrow.points(rng)).all()
    assert not near(evidence, Wall((16.6, 30.1), (16.8, 33.9)).points(rng)).any()
