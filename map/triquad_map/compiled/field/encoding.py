"""The field's encoding of a tile in compiled code: interpolated features and Fourier features.

The same as :mod:`triquad_server.engine.corners` and :mod:`triquad_server.engine.field` compute with
tensors.
Fourier phases are counted in turns, not radians, which makes their reduction exact.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.region import AXES

from triquad_map.compiled.field.batch import TILE, Tile
from triquad_map.compiled.field.feature_rows import add_rows, add_to_row, prefetch_row
from triquad_map.compiled.field.quadtree import Shape, Vertices, block_key
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.sparse.voxel_index import EMPTY, find_row

Floats = NDArray[np.float32]

_AXES = np.array(AXES)
_TURN = np.float32(2 * np.pi)
_BELOW_1 = np.nextafter(np.float32(1), np.float32(0))


class Geometry(NamedTuple):
    """Numbers that place points among the vertices."""

    leaf_m: float
    half_side: float  # of the cube, in leaves
    levels: int  # H, or 0 where the field has no features
    shape: Shape  # of the trees


@kernel(fastmath=True)
def locate(tile: Tile, geometry: Geometry, vertices: Vertices, features: Floats) -> None:
    """The cells around the tile's points, and the rows of their vertices."""
    for plane in range(3):
        _find_blocks(tile, plane, geometry, vertices)
        _find_cells(tile, plane, geometry)
    for t in range(TILE):
        for plane in range(3):
            block = vertices.rows[tile.blocks[plane, t]]
            for h in range(geometry.levels):
                at = plane * geometry.levels + h
                corner = tile.corners[at, t]
                side = (1 << h) + 1
                for i in range(4):
                    row = block[corner + (i & 1) * side + (i >> 1)]
                    tile.rows[t, 4 * at + i] = row
                    prefetch_row(features, row)


@kernel(fastmath=True)
def _find_blocks(tile: Tile, plane: int, geometry: Geometry, vertices: Vertices) -> None:
    first, second = _AXES[plane, 0], _AXES[plane, 1]
    scale = np.float32(1 << (geometry.levels - 1))
    limit = geometry.shape.limit
    for t in range(TILE):
        u = (tile.points[first, t] / geometry.leaf_m + geometry.half_side) / scale
        v = (tile.points[second, t] / geometry.leaf_m + geometry.half_side) / scale
        floor_u, floor_v = np.floor(u), np.floor(v)
        block_u, block_v = np.int64(floor_u), np.int64(floor_v)
        inside = (block_u >= 0) & (block_v >= 0) & (block_u < limit) & (block_v < limit)
        tile.keys[t] = block_key(plane, block_u, block_v) if inside else EMPTY
        # Just below 0, rounding may take the difference to 1.
        tile.local[0, t] = min(u - floor_u, _BELOW_1) if inside else np.float32(0)
        tile.local[1, t] = min(v - floor_v, _BELOW_1) if inside else np.float32(0)
    for t in range(TILE):
        number = max(0, find_row(vertices.blocks, tile.keys[t]))
        tile.blocks[plane, t] = number
        prefetch_row(vertices.rows, number)


@kernel(fastmath=True)
def _find_cells(tile: Tile, plane: int, geometry: Geometry) -> None:
    for h in range(geometry.levels):
        at = plane * geometry.levels + h
        cells = np.float32(1 << h)
        side = np.int32((1 << h) + 1)
        start = np.int32(geometry.shape.starts[h])
        for t in range(TILE):
            u, v = tile.local[0, t] * cells, tile.local[1, t] * cells
            cell_u, cell_v = np.int32(u), np.int32(v)
            tile.across[at, t] = u - np.float32(cell_u)
            tile.along[at, t] = v - np.float32(cell_v)
            tile.corners[at, t] = start + cell_u * side + cell_v


@kernel(fastmath=True, inline="always")
def _weights(tile: Tile, at: int, t: int) -> tuple[float, float, float, float]:
    """Bilinear weights of the 4 vertices, in the order of their rows."""
    a, b = tile.across[at, t], tile.along[at, t]
    both = a * b
    return np.float32(1) - a - b + both, a - both, b - both, both


@kernel(fastmath=True)
def interpolate(tile: Tile, levels: int, features: Floats) -> None:
    """The first inputs of the MLP: features summed over the planes, level by level."""
    size = features.shape[1]
    tile.features[:] = 0
    for t in range(TILE):
        for at in range(3 * levels):
            first = 4 * at
            add_rows(
                tile.features,
                t,
                (at % levels) * size,
                features,
                (
                    tile.rows[t, first],
                    tile.rows[t, first + 1],
                    tile.rows[t, first + 2],
                    tile.rows[t, first + 3],
                ),
                _weights(tile, at, t),
            )
    for k in range(levels * size):
        for t in range(TILE):
            tile.x[k, t] = tile.features[t, k]


@kernel(fastmath=True)
def add_feature_gradient(
    tile: Tile,
    count: int,
    levels: int,
    sums: Floats,
) -> None:
    """Add the gradient of the first ``count`` points' features to ``sums`` [rows, d]."""
    size = sums.shape[1]
    _turn_over(tile, levels * size)
    for t in range(count):
        for at in range(3 * levels):
            start = (at % levels) * size
            weights = _weights(tile, at, t)
            add_to_row(sums, tile.rows[t, 4 * at], weights[0], tile.features, t, start)
            add_to_row(sums, tile.rows[t, 4 * at + 1], weights[1], tile.features, t, start)
            add_to_row(sums, tile.rows[t, 4 * at + 2], weights[2], tile.features, t, start)
            add_to_row(sums, tile.rows[t, 4 * at + 3], weights[3], tile.features, t, start)


@kernel(fastmath=True)
def add_feature_slopes(tile: Tile, geometry: Geometry, features: Floats) -> None:
    """Add what the features contribute to the gradient with respect to the points."""
    levels = geometry.levels
    size = features.shape[1]
    _turn_over(tile, levels * size)
    for t in range(TILE):
        for at in range(3 * levels):
            plane, h = at // levels, at % levels
            a, b = tile.across[at, t], tile.along[at, t]
            r00, r10 = tile.rows[t, 4 * at], tile.rows[t, 4 * at + 1]
            r01, r11 = tile.rows[t, 4 * at + 2], tile.rows[t, 4 * at + 3]
            across, along = np.float32(0), np.float32(0)
            for k in range(size):
                f00, f10, f01 = features[r00, k], features[r10, k], features[r01, k]
                twist = features[r11, k] - f10 - f01 + f00
                g = tile.features[t, h * size + k]
                across += g * (f10 - f00 + b * twist)
                along += g * (f01 - f00 + a * twist)
            per_m = np.float32(1 << h) / (np.float32(1 << (levels - 1)) * geometry.leaf_m)
            tile.gradient[_AXES[plane, 0], t] += across * per_m
            tile.gradient[_AXES[plane, 1], t] += along * per_m


@kernel()
def _turn_over(tile: Tile, count: int) -> None:
    """The gradient of the first ``count`` inputs, point by point, into ``tile.features``."""
    for k in range(count):
        for t in range(TILE):
            tile.features[t, k] = tile.gx[k, t]


@kernel(fastmath=True, inline="always")
def _cosine(turns: float) -> float:
    """Cosine of an angle in turns; a polynomial, which compiles to vector instructions."""
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
def wave(tile: Tile, first: int, turns_per_m: Floats) -> None:
    """Fourier features, from input ``first`` on: sines of all axes, then cosines."""
    m = len(turns_per_m)
    for axis in range(3):
        for i in range(m):
            sine, cosine = first + axis * m + i, first + (3 + axis) * m + i
            for t in range(TILE):
                turns = tile.points[axis, t] * turns_per_m[i]
                tile.x[cosine, t] = _cosine(turns)
                tile.x[sine, t] = _cosine(turns - np.float32(0.25))


@kernel(fastmath=True)
def add_wave_slopes(tile: Tile, first: int, turns_per_m: Floats) -> None:
    """Add what the Fourier features contribute to the gradient with respect to the points."""
    m = len(turns_per_m)
    for axis in range(3):
        for i in range(m):
            sine, cosine = first + axis * m + i, first + (3 + axis) * m + i
            rate = turns_per_m[i] * _TURN
            for t in range(TILE):
                tilt = tile.gx[sine, t] * tile.x[cosine, t] - tile.gx[cosine, t] * tile.x[sine, t]
                tile.gradient[axis, t] += rate * tilt
