"""Points that kernels work on at a time, and what they work out of them.

The last axis of nearly all arrays runs over the points of the batch, so that every loop over them
is made of vector instructions; and a batch is small enough to stay in the cache nearest to the
core.
"""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Floats, Ints, Longs

from triquad_map.compiled.kernel import kernel

BATCH = 64
"""Points of a batch."""


class PointBatch(NamedTuple):
    """Room for one batch, with ``T = BATCH``, ``H`` levels and features of length ``d``."""

    points: Floats  # [3, T] metres from the region's centre
    keys: Longs  # [T] of the blocks on one plane
    blocks: Ints  # [3, T] number of the block on each plane, 0 where there is none
    local: Floats  # [2, T] place within the block on one plane, in blocks
    corners: Ints  # [3 H, T] within the block: the cell's vertex of least coordinates
    across: Floats  # [3 H, T] place within the cell along the plane's first axis, in cells
    along: Floats  # [3 H, T] and along its second
    rows: Ints  # [T, 12 H] of the feature table: 4 vertices for each plane and level
    features: Floats  # [T, H d] interpolated and summed over the planes, or their gradient
    x: Floats  # [input, T] of the MLP
    gx: Floats  # [input, T] its gradient
    h1: Floats  # [hidden, T] first layer, after the ReLU
    h2: Floats  # [hidden, T] second layer
    g1: Floats  # [hidden, T] gradient before the ReLU of the first layer
    g2: Floats  # [hidden, T] and of the second
    logits: Floats  # [T]
    slopes: Floats  # [T] gradient of the logits
    gradient: Floats  # [3, T] of the logits with respect to the points, per metre


@kernel()
def new_batch(levels: int, size: int, inputs: int, hidden: int) -> PointBatch:
    """Room for a batch: ``levels`` of features of length ``size``, an MLP's inputs and width."""
    return PointBatch(
        np.zeros((3, BATCH), np.float32),
        np.zeros(BATCH, np.int64),
        np.zeros((3, BATCH), np.int32),
        np.zeros((2, BATCH), np.float32),
        np.zeros((3 * levels, BATCH), np.int32),
        np.zeros((3 * levels, BATCH), np.float32),
        np.zeros((3 * levels, BATCH), np.float32),
        np.zeros((BATCH, 12 * levels), np.int32),
        np.zeros((BATCH, levels * size), np.float32),
        np.zeros((inputs, BATCH), np.float32),
        np.zeros((inputs, BATCH), np.float32),
        np.zeros((hidden, BATCH), np.float32),
        np.zeros((hidden, BATCH), np.float32),
        np.zeros((hidden, BATCH), np.float32),
        np.zeros((hidden, BATCH), np.float32),
        np.zeros(BATCH, np.float32),
        np.zeros(BATCH, np.float32),
        np.zeros((3, BATCH), np.float32),
    )


@kernel()
def load(batch: PointBatch, points: Floats, first: int) -> int:
    """Take up points [N, 3] from ``first`` on; returns how many, the last fills up the rest."""
    count: int = min(BATCH, len(points) - first)
    for t in range(BATCH):
        i = first + min(t, count - 1)
        for axis in range(3):
            batch.points[axis, t] = points[i, axis]
    return count
