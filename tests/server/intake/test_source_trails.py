import tracemalloc

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from support.poses import shifted
from triquad_format.wire.messages import Scan
from triquad_format.wire.source_messages import SourcesRequest
from triquad_server.intake.rays import ScanRays
from triquad_server.intake.source_trails import MAX_POSITIONS, MAX_SOURCES, SourceTrails

LEAF_M = 0.2


def add(trails, position, source="lidar"):
    pose = shifted(*position)
    scan = Scan(np.zeros((0, 3), np.float32), pose, 1, source, 7, 0)
    trails.add(scan, ScanRays(pose[:3, 3], pose[None, :3, 3] + (3.0, 0, 0), {}))


def states(trails):
    return trails.answer(SourcesRequest("", -1, 0)).sources


def test_a_long_drive_remains_visible_as_a_whole():
    trails = SourceTrails(LEAF_M)
    steps = 5 * MAX_POSITIONS
    for step in range(steps):
        add(trails, (step * 0.3, 0, 0))
    source = states(trails)["lidar"]
    trail, pieces = source.trail, source.pieces
    assert MAX_POSITIONS / 2 <= len(trail) <= MAX_POSITIONS
    assert trail[0, 0] == 0
    gaps = np.diff(trail[:, 0], append=steps * 0.3)
    assert gaps.max() < 20 * np.median(gaps) < 100
    assert not pieces.any()


POSITIONS = st.tuples(
    st.sampled_from([-60.0, -1.0, 0.0, 0.1, 0.5, 1.0, 60.0]), st.just(0), st.just(0)
)
STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("add"), st.sampled_from("ab"), POSITIONS),
        st.tuples(st.just("forget"), st.sampled_from([0.0, 0.7, np.inf])),
    ),
    max_size=60,
)


@given(STEPS)
def test_positions_of_a_piece_are_a_leaf_apart_and_no_jump(steps):
    trails, taken = SourceTrails(LEAF_M), 0
    for what, *values in steps:
        if what == "add":
            add(trails, values[1], source=values[0])
            taken += 1
        else:
            trails.forget(np.full(3, -values[0]), np.full(3, values[0]))
    sources = states(trails).values()
    for source in sources:
        apart = np.linalg.norm(np.diff(source.trail, axis=0), axis=1)
        joined = np.diff(source.pieces) == 0
        assert (np.diff(source.pieces) >= 0).all()
        assert (apart[joined] < 50 + LEAF_M).all()
        assert (apart[joined] >= LEAF_M).all()
    assert sum(source.scans for source in sources) <= taken


def test_sources_that_somebody_invents_take_little_memory():
    trails = SourceTrails(LEAF_M)
    tracemalloc.start()
    try:
        for number in range(2 * MAX_SOURCES):
            add(trails, (0, 0, 0), source=f"invented-{number}")
        used, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(states(trails)) == MAX_SOURCES
    assert used < 4096 * MAX_SOURCES
