import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from triquad_map.clusters import connected, tight_boxes

CELL = st.tuples(*[st.integers(-3, 3)] * 3)
CELLS = st.lists(CELL, max_size=40)
OFFSET = st.tuples(*[st.integers(-(10**7), 10**7)] * 3)


def rows(cells):
    return np.array(cells, np.int64).reshape(-1, 3)


def slow_clusters(cells, most_apart=1):
    """Sets of different cells that hang together, one found after the other."""
    left, found = set(cells), []
    while left:
        cluster, new = set(), {left.pop()}
        while new:
            cluster |= new
            near = {
                other
                for other in left
                if any(max(abs(p - q) for p, q in zip(one, other, strict=True)) <= most_apart
                       for one in new)
            }  # fmt: skip
            left -= near
            new = near
        found.append(frozenset(cluster))
    return set(found)


@given(CELLS, OFFSET)
def test_cells_that_touch_are_in_one_cluster_and_no_others(cells, offset):
    cluster = connected(rows(cells) + offset)
    found = {
        frozenset(cell for cell, number in zip(cells, cluster, strict=True) if number == one)
        for one in set(cluster.tolist())
    }
    assert found == slow_clusters(cells)
    assert set(cluster.tolist()) == set(range(len(found)))


@pytest.mark.parametrize("length", [1000, 1001])
def test_a_long_winding_cluster_is_one(length):
    turns = np.random.default_rng(0).integers(-1, 2, (length, 3))
    assert connected(np.cumsum(turns, axis=0)).max() == 0


@given(CELLS, st.integers(1, 8), st.integers(1, 3))
def test_boxes_are_tight_and_no_longer_than_they_may_be(cells, longest, scale):
    voxels = rows(cells)
    boxes = tight_boxes(voxels, longest, scale=scale)
    assert len(boxes.box) == len(voxels)
    assert (boxes.high - boxes.low <= scale * longest).all()
    for box in range(len(boxes.low)):
        inside = voxels[boxes.box == box]
        np.testing.assert_array_equal(boxes.low[box], inside.min(axis=0))
        np.testing.assert_array_equal(boxes.high[box], inside.max(axis=0) + 1)


@given(CELLS)
def test_what_is_two_apart_shares_a_box_and_what_is_four_apart_does_not(cells):
    boxes = tight_boxes(rows(cells), 100).box.tolist()
    box_of = dict(zip(cells, boxes, strict=True))
    for cluster in slow_clusters(cells, 2):
        assert len({box_of[cell] for cell in cluster}) == 1
    for cluster in slow_clusters(cells, 3):
        others = set(cells) - cluster
        assert not {box_of[cell] for cell in cluster} & {box_of[cell] for cell in others}
