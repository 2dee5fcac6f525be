"""The points of a grid that lie near seen surface: found by the voxels, not point by point.

Mesh tiles ask this of all their cells, of which few are near any.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Bools, Doubles, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import BLOCK_BYTES

from triquad_map.compiled.evidence.seen_voxels import SeenVoxels
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.voxel_index import LOW, SHIFT, find_block


class _Axis(NamedTuple):
    """The points of a grid on one axis, by the voxels that they reach."""

    voxel: int  # the first
    begins: Longs  # [V] first point that reaches each voxel from there on
    ends: Longs  # [V] the point after the last


def surface_in_grid(axes: Sequence[Doubles], reach: float, seen: SeenVoxels) -> Bools:
    """Return which points [X, Y, Z] of a grid have surface voxels within ``reach`` on each axis.

    ``axes`` are their leaf coordinates [X], [Y] and [Z], increasing.
    """
    near = np.zeros([len(axis) for axis in axes], np.bool_)
    if near.size:
        x, y, z = (_axis(axis, reach) for axis in axes)
        _mark(x, y, z, seen, near)
    return near


def _axis(places: Doubles, reach: float) -> _Axis:
    low = np.floor(places - reach).astype(np.int64)
    high = np.floor(places + reach).astype(np.int64)
    voxels = np.arange(low[0], high[-1] + 1)
    begins, ends = np.searchsorted(high, voxels), np.searchsorted(low, voxels, side="right")
    return _Axis(int(low[0]), begins, ends)


@kernel()
def _mark(x: _Axis, y: _Axis, z: _Axis, seen: SeenVoxels, near: Bools) -> None:
    """Mark the points that any surface voxel is reached from, block by block."""
    for i in range(x.voxel >> SHIFT, ((x.voxel + len(x.begins) - 1) >> SHIFT) + 1):
        for j in range(y.voxel >> SHIFT, ((y.voxel + len(y.begins) - 1) >> SHIFT) + 1):
            for k in range(z.voxel >> SHIFT, ((z.voxel + len(z.begins) - 1) >> SHIFT) + 1):
                row = find_block(seen.blocks, i << SHIFT, j << SHIFT, k << SHIFT, seen.side)
                for byte in range(BLOCK_BYTES if row >= 0 else 0):
                    bits = int(seen.surface[row, byte])
                    u = (i << SHIFT) + (byte >> SHIFT) - x.voxel
                    v = (j << SHIFT) + (byte & LOW) - y.voxel
                    if bits == 0 or not (0 <= u < len(x.begins) and 0 <= v < len(y.begins)):
                        continue
                    for inner in range(BLOCK_VOXELS):
                        w = (k << SHIFT) + inner - z.voxel
                        if bits >> inner & 1 and 0 <= w < len(z.begins):
                            for a in range(x.begins[u], x.ends[u]):
                                for b in range(y.begins[v], y.ends[v]):
                                    near[a, b, z.begins[w] : z.ends[w]] = True
