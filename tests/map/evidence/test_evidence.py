import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from support.maps.seen_scans import see
from triquad_format.records.status import Status
from triquad_map.evidence.carving import Reach
from triquad_map.evidence.evidence import FrozenEvidence
from triquad_map.evidence.live_evidence import LiveEvidence
from triquad_map.evidence.observed import Sighting
from triquad_map.surface import LEVELS

SIDE = 64
RNG = np.random.default_rng(0)


def voxel(*xyz: float) -> np.ndarray:
    return np.array([xyz], float)


def test_surface_reaches_half_a_voxel() -> None:
    evidence = LiveEvidence(SIDE)
    evidence.mark("surface", voxel(10.5, 20.5, 30.5))
    near = voxel(11.49, 20.5, 30.5), voxel(9.51, 19.51, 29.51), voxel(10.01, 20.99, 30.5)
    far = voxel(11.51, 20.5, 30.5), voxel(10.5, 20.5, 29.49)
    assert [int(evidence.freeze().status(p)[0]) for p in near] == [Status.SURFACE] * 3
    assert [int(evidence.freeze().status(p)[0]) for p in far] == [Status.UNKNOWN] * 2
    assert evidence.freeze().status(far[0], reach=1.0)[0] == Status.SURFACE


def test_a_ray_carves_the_voxels_it_crosses_and_stops_short() -> None:
    evidence = LiveEvidence(SIDE)
    origin, end = np.array([2.2, 3.3, 4.4]), np.array([[50.7, 31.1, 17.9]])
    evidence.carve(origin, end, Reach(0.5))
    direction = (end[0] - origin) / np.linalg.norm(end[0] - origin)
    length = np.linalg.norm(end[0] - origin)
    along = origin + np.linspace(0, length - 0.51, 5000)[:, None] * direction
    assert (evidence.freeze().status(along) == Status.FREE).all()
    beyond = origin + np.linspace(length + 1.5, length + 9, 50)[:, None] * direction
    assert (evidence.freeze().status(beyond) == Status.UNKNOWN).all()
    crossed = len(np.unique(np.floor(along), axis=0))
    everywhere = np.stack(np.meshgrid(*[np.arange(SIDE) + 0.5] * 3, indexing="ij"), -1)
    free = (evidence.freeze().status(everywhere.reshape(-1, 3)) == Status.FREE).sum()
    assert crossed <= free <= crossed + 2, "no voxel beside the ray is carved"


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.integers(1, 3000))
def test_it_remembers_exactly_the_marked_voxels(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-4, SIDE + 4, (count, 3))
    evidence = LiveEvidence(SIDE)
    evidence.mark("surface", points)
    inside = points[((points >= 0) & (points < SIDE)).all(axis=1)]
    marked = {tuple(cell) for cell in np.floor(inside).astype(int).tolist()}
    asked = rng.integers(0, SIDE, (2000, 3))
    expected = [tuple(cell) in marked for cell in asked.tolist()]
    status = evidence.freeze().status(asked + 0.5, reach=0.4)
    assert (status == Status.SURFACE).tolist() == expected


def test_a_record_restores_it() -> None:
    evidence = LiveEvidence(SIDE)
    evidence.mark("surface", RNG.uniform(0, SIDE, (5000, 3)))
    evidence.carve(np.full(3, 32.0), RNG.uniform(0, SIDE, (300, 3)), Reach(0.5))
    record = evidence.freeze().record()
    assert (np.diff(record.codes) > 0).all()
    restored = LiveEvidence.from_record(SIDE, record)
    asked = RNG.uniform(-2, SIDE + 2, (20_000, 3))
    for again in (restored.freeze(), FrozenEvidence.from_record(SIDE, record)):
        np.testing.assert_array_equal(again.status(asked), evidence.freeze().status(asked))
    restored.mark("surface", RNG.uniform(0, SIDE, (3000, 3)))
    assert restored.size.blocks >= len(record.codes)


def test_clearing_forgets_a_box_and_no_more() -> None:
    evidence = LiveEvidence(SIDE)
    grid = np.stack(np.meshgrid(*[np.arange(SIDE) + 0.5] * 3, indexing="ij"), -1).reshape(-1, 3)
    evidence.mark("surface", grid)
    low, high = np.array([3.0, 10.0, 20.0]), np.array([17.0, 30.0, 21.0])
    evidence.clear(low, high)
    inside = ((grid > low) & (grid < high)).all(axis=1)
    status = evidence.freeze().status(grid, reach=0.1)
    assert (status[inside] == Status.UNKNOWN).all()
    assert (status[~inside] == Status.SURFACE).all()


def test_support_rises_with_each_look_from_near_and_from_other_sides() -> None:
    ends = np.array([[20.5, 20.5, 20.5], [60.5, 20.5, 20.5]])

    def level_after(*origins: tuple[float, ...]) -> int:
        evidence = LiveEvidence(SIDE)
        for origin in origins:
            see(evidence, ends[:1], Sighting(np.array(origin), 0.2, 1_000, scan=1))
        return int(evidence.freeze().levels[0])

    near, far = (25.0, 20.5, 20.5), (120.0, 20.5, 20.5)
    assert level_after(near) > level_after(far)
    assert level_after(near, near, near, near) > level_after(near)
    other_side = (15.0, 20.5, 20.5)
    assert level_after(near, other_side, near, other_side) > level_after(near, near, near, near)
    assert level_after(*[near, other_side] * 100) == LEVELS - 1


def test_levels_and_times_survive_a_record() -> None:
    evidence = LiveEvidence(SIDE)
    origins = [np.array([64.0, 64, 64]), np.array([10.0, 64, 64])]
    rng = np.random.default_rng(5)
    for stamp_s, origin in zip((6_000, 9_000), origins, strict=True):
        ends = rng.uniform(0, SIDE, (3_000, 3)) ** 2 / SIDE  # many in some blocks
        see(evidence, ends, Sighting(origin, 0.2, stamp_s, scan=1))
    record = evidence.freeze().record()
    again = LiveEvidence.from_record(SIDE, record).freeze().record()
    np.testing.assert_array_equal(again.levels, record.levels)
    np.testing.assert_array_equal(again.seen_s, record.seen_s)
    assert len(np.unique(record.levels)) > 2
    assert set(np.unique(record.seen_s)) == {6_000, 9_000}
    frozen = evidence.freeze()
    see(evidence, ends, Sighting(origins[0], 0.2, 12_000, scan=2))
    np.testing.assert_array_equal(frozen.record().seen_s, record.seen_s)


def crossed(origin: np.ndarray, end: np.ndarray, least: float) -> set[tuple[int, ...]]:
    """Voxels in which a ray goes farther than ``least``: the slow way."""
    way = end - origin
    stops = [0.0, 1.0]
    for axis in np.flatnonzero(way):
        planes = np.arange(min(origin[axis], end[axis]) // 1, max(origin[axis], end[axis]) + 1)
        stops += list((planes - origin[axis]) / way[axis])
    at = np.unique(np.clip(stops, 0.0, 1.0))
    apart = np.diff(at) * np.linalg.norm(way)
    middles = origin + ((at[:-1] + at[1:]) / 2)[:, None] * way
    voxels = np.floor(middles[apart > least]).astype(int)
    return {tuple(v) for v in voxels.tolist() if min(v) >= 0 and max(v) < SIDE}


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40))
def test_open_rays_mark_the_voxels_that_they_cross_and_no_others(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    origin = rng.uniform(-10, SIDE + 10, 3)
    directions = rng.normal(size=(count, 3))
    directions *= rng.random((count, 3)) > 0.2  # some along an axis or a plane
    directions = directions[directions.any(axis=1)]
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    ends = origin + rng.uniform(5, 80) * directions / lengths
    evidence = LiveEvidence(SIDE)
    evidence.carve(origin, ends, Reach(0.0))
    voxels = np.stack(np.meshgrid(*[np.arange(SIDE)] * 3, indexing="ij"), -1).reshape(-1, 3)
    free = evidence.freeze().status(voxels + 0.5) == Status.FREE
    marked = {tuple(v) for v in voxels[free].tolist()}
    # Where a ray only touches a voxel, rounding decides.
    assert set().union(*(crossed(origin, end, 1e-6) for end in ends)) <= marked
    near = [crossed(origin + shift, end + shift, 0.0) for end in ends for shift in _SHIFTS]
    assert marked <= set().union(*near)


_SHIFTS = 1e-6 * np.stack(np.meshgrid(*[(-1, 0, 1)] * 3), -1).reshape(-1, 3)


def test_voxels_marked_free_keep_their_surface() -> None:
    evidence = LiveEvidence(SIDE)
    evidence.mark("surface", voxel(20.5, 20.5, 20.5))
    grid = np.stack(np.meshgrid(*[np.arange(-8, SIDE + 8) + 0.5] * 3), -1).reshape(-1, 3)
    evidence.mark("free", grid)
    inside = ((grid > 0) & (grid < SIDE)).all(axis=1)
    status = evidence.freeze().status(grid, reach=0.4)
    at_surface = (grid == 20.5).all(axis=1)
    assert (status[at_surface] == Status.SURFACE).all()
    assert (status[inside & ~at_surface] == Status.FREE).all()
    assert (status[~inside] == Status.UNKNOWN).all()
