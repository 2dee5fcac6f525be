"""Points that kernels work on at a time, and what they work out of them.

The last axis of nearly all arrays runs over the tile's points, so that every loop over them is made
of vector instructions; and a tile is small enough to stay in the cache nearest to the core.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from triquad_map.compiled.kernel import kernel

TILE = 64
"""Points of a tile."""

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]


class Tile(NamedTuple):
    """Room for one tile, with ``T = TILE``, ``H`` levels and features of length ``d``."""

    points: Floats  # [3, T] metres from the region's centre
    keys: NDArray[np.int64]  # [T] of the blocks on one plane
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
def new_tile(levels: int, size: int, inputs: int, hidden: int) -> Tile:
    """Room for a tile: ``levels`` of features of length ``size``, an MLP's inputs and width."""
    return Tile(
        np.zeros((3, TILE), np.float32),
        np.zeros(TILE, np.int64),
        np.zeros((3, TILE), np.int32),
        np.zeros((2, TILE), np.float32),
        np.zeros((3 * levels, TILE), np.int32),
        np.zeros((3 * levels, TILE), np.float32),
        np.zeros((3 * levels, TILE), np.float32),
        np.zeros((TILE, 12 * levels), np.int32),
        np.zeros((TILE, levels * size), np.float32),
        np.zeros((inputs, TILE), np.float32),
        np.zeros((inputs, TILE), np.float32),
        np.zeros((hidden, TILE), np.float32),
        np.zeros((hidden, TILE), np.float32),
        np.zeros((hidden, TILE), np.float32),
        np.zeros((hidden, TILE), np.float32),
        np.zeros(TILE, np.float32),
        np.zeros(TILE, np.float32),
        np.zeros((3, TILE), np.float32),
    )


@kernel()
def load(tile: Tile, points: Floats, first: int) -> int:
    """Take up points [N, 3] from ``first`` on; returns how many, the last fills up the rest."""
    count: int = min(TILE, len(points) - first)
    for t in range(TILE):
        i = first + min(t, count - 1)
        for axis in range(3):
            tile.points[axis, t] = points[i, axis]
    return count
