import tracemalloc

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from triquad_format.wire.messages import Scan
from triquad_server.intake.rays import ScanRays
from triquad_server.intake.source_trails import (
    MAX_POSITIONS,
    MAX_SOURCES,
    SourceTrails,
)

LEAF_M = 0.2


def add(trails, position, source="lidar"):
    pose = np.eye(4)
    pose[:3, 3] = position
    scan = Scan(np.zeros((0, 3), np.float32), pose, 1, source, 7, 0)
    trails.add(scan, ScanRays(pose[:3, 3], pose[None, :3, 3] + (3.0, 0, 0), {}))


def whole(trails, source="lidar"):
    """All that is known of a source: its trail, and the numbers of its pieces."""
    _, deltas = trails.since(0)
    return deltas[source].trail, deltas[source].pieces


class Follower:
    """Puts together what it is told, as a client does."""

    def __init__(self):
        self.revision = 0
        self.known = {}

    def ask(self, trails):
        self.revision, deltas = trails.since(self.revision)
        self.known = {name: self._after(name, new) for name, new in deltas.items()}

    def _after(self, name, new):
        if new.whole:
            return new.trail, new.pieces
        trail, pieces = self.known[name]
        return np.concatenate([trail, new.trail]), np.concatenate([pieces, new.pieces])


def test_a_long_drive_remains_visible_as_a_whole():
    trails = SourceTrails(LEAF_M)
    follower = Follower()
    steps = 5 * MAX_POSITIONS
    for step in range(steps):
        add(trails, (step * 0.3, 0, 0))
        if step % 1000 == 0:
            follower.ask(trails)
    follower.ask(trails)
    trail, pieces = whole(trails)
    assert MAX_POSITIONS / 2 <= len(trail) <= MAX_POSITIONS
    assert trail[0, 0] == 0
    gaps = np.diff(trail[:, 0], append=steps * 0.3)
    assert gaps.max() < 20 * np.median(gaps) < 100
    assert not pieces.any()
    np.testing.assert_array_equal(follower.known["lidar"][0], trail)


POSITIONS = st.tuples(
    st.sampled_from([-60.0, -1.0, 0.0, 0.1, 0.5, 1.0, 60.0]), st.just(0), st.just(0)
)
STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("add"), st.sampled_from("ab"), POSITIONS),
        st.tuples(st.just("forget"), st.sampled_from([0.0, 0.7, np.inf])),
        st.tuples(st.just("ask")),
    ),
    max_size=60,
)


@given(STEPS)
def test_whenever_one_asks_the_news_make_up_the_whole(steps):
    trails, follower, taken = SourceTrails(LEAF_M), Follower(), 0
    for what, *values in steps:
        if what == "add":
            add(trails, values[1], source=values[0])
            taken += 1
        elif what == "forget":
            trails.forget(np.full(3, -values[0]), np.full(3, values[0]))
        else:
            follower.ask(trails)
    follower.ask(trails)
    _, deltas = trails.since(0)
    assert deltas.keys() == follower.known.keys()
    for name, (trail, pieces) in follower.known.items():
        np.testing.assert_array_equal(trail, deltas[name].trail)
        np.testing.assert_array_equal(pieces, deltas[name].pieces)
        apart = np.linalg.norm(np.diff(trail, axis=0), axis=1)
        joined = np.diff(pieces) == 0
        assert (np.diff(pieces) >= 0).all()
        assert (apart[joined] < 50 + LEAF_M).all()
        assert (apart[joined] >= LEAF_M).all()
    assert sum(new.scans for new in deltas.values()) <= taken


def test_sources_that_somebody_invents_take_little_memory():
    trails = SourceTrails(LEAF_M)
    tracemalloc.start()
    try:
        for number in range(2 * MAX_SOURCES):
            add(trails, (0, 0, 0), source=f"invented-{number}")
        used, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(trails.since(0)[1]) == MAX_SOURCES
    assert used < 4096 * MAX_SOURCES
