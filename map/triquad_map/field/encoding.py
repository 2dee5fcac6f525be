"""The field's encoding of a batch of points: interpolated features and Fourier features.

The same as :mod:`triquad_server.engine.tensor_field` computes with tensors. Fourier phases are
counted in turns, not radians, which makes their reduction exact.
"""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Floats, Ints, Longs
from triquad_format.records.region import AXES

from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.lanes import prefetch_row
from triquad_map.compiled.voxel_index import EMPTY, find_row
from triquad_map.field.feature_rows import add_rows, add_to_row, row_slopes
from triquad_map.field.quadtree import Shape, Vertices, block_key

BATCH = 64
"""Points of a batch."""

PLANE_AXES = np.array(AXES)
"""The two axes of each plane, as kernels take them."""

_TURN = np.float32(2 * np.pi)
_BELOW_1 = np.nextafter(np.float32(1), np.float32(0))


class PointBatch(NamedTuple):
    """Room for one batch, with ``T = BATCH``, ``H`` levels and features of length ``d``.

    The last axis of nearly all arrays runs over the points, so that every loop over them is made of
    vector instructions; and a batch is small enough to stay in the cache nearest to the core.
    """

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
    """Return room for a batch: ``levels`` of features of length ``size``, MLP inputs and width."""
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


class Geometry(NamedTuple):
    """Numbers that place points among the vertices."""

    leaf_m: float
    half_side: float  # of the cube, in leaves
    levels: int  # H, or 0 where the field has no features
    shape: Shape  # of the trees


@kernel(fastmath=True)
def locate(batch: PointBatch, geometry: Geometry, vertices: Vertices, features: Floats) -> None:
    """Find the cells around the batch's points, and the rows of their vertices."""
    for plane in range(3):
        _find_blocks(batch, plane, geometry, vertices)
        _find_cells(batch, plane, geometry)
    for t in range(BATCH):
        for plane in range(3):
            block = vertices.rows[batch.blocks[plane, t]]
            for h in range(geometry.levels):
                at = plane * geometry.levels + h
                corner = batch.corners[at, t]
                side = (1 << h) + 1
                for i in range(4):
                    row = block[corner + (i & 1) * side + (i >> 1)]
                    batch.rows[t, 4 * at + i] = row
                    prefetch_row(features, row)


@inner_kernel(fastmath=True)
def _find_blocks(batch: PointBatch, plane: int, geometry: Geometry, vertices: Vertices) -> None:
    first, second = PLANE_AXES[plane, 0], PLANE_AXES[plane, 1]
    scale = np.float32(1 << (geometry.levels - 1))
    limit = geometry.shape.limit
    for t in range(BATCH):
        u = (batch.points[first, t] / geometry.leaf_m + geometry.half_side) / scale
        v = (batch.points[second, t] / geometry.leaf_m + geometry.half_side) / scale
        floor_u, floor_v = np.floor(u), np.floor(v)
        block_u, block_v = np.int64(floor_u), np.int64(floor_v)
        inside = (block_u >= 0) & (block_v >= 0) & (block_u < limit) & (block_v < limit)
        batch.keys[t] = block_key(plane, block_u, block_v) if inside else EMPTY
        # Just below 0, rounding may take the difference to 1.
        batch.local[0, t] = min(u - floor_u, _BELOW_1) if inside else np.float32(0)
        batch.local[1, t] = min(v - floor_v, _BELOW_1) if inside else np.float32(0)
    for t in range(BATCH):
        number = max(0, find_row(vertices.blocks, batch.keys[t]))
        batch.blocks[plane, t] = number
        prefetch_row(vertices.rows, number)


@inner_kernel(fastmath=True)
def _find_cells(batch: PointBatch, plane: int, geometry: Geometry) -> None:
    for h in range(geometry.levels):
        at = plane * geometry.levels + h
        cells = np.float32(1 << h)
        side = np.int32((1 << h) + 1)
        start = np.int32(geometry.shape.starts[h])
        for t in range(BATCH):
            u, v = batch.local[0, t] * cells, batch.local[1, t] * cells
            cell_u, cell_v = np.int32(u), np.int32(v)
            batch.across[at, t] = u - np.float32(cell_u)
            batch.along[at, t] = v - np.float32(cell_v)
            batch.corners[at, t] = start + cell_u * side + cell_v


@kernel(inline="always")
def _corner_rows(batch: PointBatch, at: int, t: int) -> tuple[int, int, int, int]:
    """Return rows of the 4 vertices around a point, on one plane and level."""
    i = 4 * at
    return batch.rows[t, i], batch.rows[t, i + 1], batch.rows[t, i + 2], batch.rows[t, i + 3]


@kernel(fastmath=True, inline="always")
def _weights(batch: PointBatch, at: int, t: int) -> tuple[float, float, float, float]:
    """Return bilinear weights of the 4 vertices, in the order of their rows."""
    a, b = batch.across[at, t], batch.along[at, t]
    both = a * b
    return np.float32(1) - a - b + both, a - both, b - both, both


@inner_kernel(fastmath=True)
def interpolate(batch: PointBatch, levels: int, features: Floats) -> None:
    """Compute the first inputs of the MLP: features summed over the planes, level by level."""
    size = features.shape[1]
    batch.features[:] = 0
    for t in range(BATCH):
        for plane in range(3):
            for h in range(levels):
                at = plane * levels + h
                weights = _weights(batch, at, t)
                add_rows(batch.features, t, h * size, features, _corner_rows(batch, at, t), weights)
    _transpose_features(batch, levels * size)


@inner_kernel(fastmath=True)
def interpolate_plane(
    batch: PointBatch, plane: int, geometry: Geometry, vertices: Vertices, features: Floats
) -> None:
    """Do as :func:`locate` and :func:`interpolate`, with the features of one plane alone."""
    size = features.shape[1]
    _find_blocks(batch, plane, geometry, vertices)
    _find_cells(batch, plane, geometry)
    batch.features[:] = 0
    for t in range(BATCH):
        block = vertices.rows[batch.blocks[plane, t]]
        for h in range(geometry.levels):
            at = plane * geometry.levels + h
            below = batch.corners[at, t]
            above = below + (1 << h) + 1
            rows = (block[below], block[above], block[below + 1], block[above + 1])
            add_rows(batch.features, t, h * size, features, rows, _weights(batch, at, t))
    _transpose_features(batch, geometry.levels * size)


@inner_kernel(fastmath=True)
def _transpose_features(batch: PointBatch, count: int) -> None:
    """Compute the first ``count`` inputs of the MLP, from the features of each point."""
    for k in range(count):
        for t in range(BATCH):
            batch.x[k, t] = batch.features[t, k]


@inner_kernel(fastmath=True)
def add_feature_gradient(batch: PointBatch, count: int, levels: int, sums: Floats) -> None:
    """Add the gradient of the first ``count`` points' features to ``sums`` [rows, d]."""
    size = sums.shape[1]
    _transpose_gradient(batch, levels * size)
    for t in range(count):
        for plane in range(3):
            for h in range(levels):
                at = plane * levels + h
                rows, weights = _corner_rows(batch, at, t), _weights(batch, at, t)
                add_to_row(sums, rows[0], weights[0], batch.features, t, h * size)
                add_to_row(sums, rows[1], weights[1], batch.features, t, h * size)
                add_to_row(sums, rows[2], weights[2], batch.features, t, h * size)
                add_to_row(sums, rows[3], weights[3], batch.features, t, h * size)


@inner_kernel(fastmath=True)
def add_feature_slopes(batch: PointBatch, geometry: Geometry, features: Floats) -> None:
    """Add what the features contribute to the gradient with respect to the points."""
    levels = geometry.levels
    size = features.shape[1]
    _transpose_gradient(batch, levels * size)
    for t in range(BATCH):
        for plane in range(3):
            across, along = np.float32(0), np.float32(0)
            for h in range(levels):
                at = plane * levels + h
                rows, place = _corner_rows(batch, at, t), (batch.across[at, t], batch.along[at, t])
                slopes = row_slopes(batch.features, t, h * size, features, rows, place)
                per_leaf = np.float32(1 << h) / np.float32(1 << (levels - 1))
                across += slopes[0] * per_leaf
                along += slopes[1] * per_leaf
            batch.gradient[PLANE_AXES[plane, 0], t] += across / geometry.leaf_m
            batch.gradient[PLANE_AXES[plane, 1], t] += along / geometry.leaf_m


@inner_kernel()
def _transpose_gradient(batch: PointBatch, count: int) -> None:
    """Copy the gradient of the first ``count`` inputs, point by point, into ``batch.features``."""
    for k in range(count):
        for t in range(BATCH):
            batch.features[t, k] = batch.gx[k, t]


@kernel(fastmath=True, inline="always")
def _cosine(turns: float) -> float:
    """Return the cosine of an angle in turns, a polynomial that compiles to vector instructions."""
    t = turns - np.floor(turns + np.float32(0.5))
    u = np.float32(0.25) - abs(t)
    v = u * u
    p: float = np.float32(-15.094643)
    p = p * v + np.float32(42.058693)
    p = p * v + np.float32(-76.705860)
    p = p * v + np.float32(81.605249)
    p = p * v + np.float32(-41.341702)
    p = p * v + np.float32(6.2831853)
    cosine: float = p * u
    return cosine


@kernel(fastmath=True)
def wave(batch: PointBatch, first: int, turns_per_m: Floats) -> None:
    """Compute Fourier features, from input ``first`` on: sines of all axes, then cosines."""
    m = len(turns_per_m)
    for axis in range(3):
        for i in range(m):
            sine, cosine = first + axis * m + i, first + (3 + axis) * m + i
            for t in range(BATCH):
                turns = batch.points[axis, t] * turns_per_m[i]
                batch.x[cosine, t] = _cosine(turns)
                batch.x[sine, t] = _cosine(turns - np.float32(0.25))


@inner_kernel(fastmath=True)
def add_wave_slopes(batch: PointBatch, first: int, turns_per_m: Floats) -> None:
    """Add what the Fourier features contribute to the gradient with respect to the points."""
    m = len(turns_per_m)
    for axis in range(3):
        for i in range(m):
            sine, cosine = first + axis * m + i, first + (3 + axis) * m + i
            rate = turns_per_m[i] * _TURN
            for t in range(BATCH):
                tilt = (
                    batch.gx[sine, t] * batch.x[cosine, t] - batch.gx[cosine, t] * batch.x[sine, t]
                )
                batch.gradient[axis, t] += rate * tilt
