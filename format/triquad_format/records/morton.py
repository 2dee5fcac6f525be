"""Morton (Z-order) codes: the keys of quadtree vertices and of evidence blocks.

Bit ``i`` of the first coordinate lands at bit ``i * D`` of the code, of the second at
``i * D + 1``, and so on, for ``D`` coordinates.
"""

import numpy as np
from numpy.typing import NDArray

from triquad_format.records.arrays import Longs

SPREAD_2D = (
    (16, 0x0000FFFF0000FFFF),
    (8, 0x00FF00FF00FF00FF),
    (4, 0x0F0F0F0F0F0F0F0F),
    (2, 0x3333333333333333),
    (1, 0x5555555555555555),
)
"""Shifts and masks that move bit ``i`` of a number to bit ``2 * i``."""

SPREAD_3D = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Return shifts and masks that move bit ``i`` of a number to bit ``3 * i``."""


def encode(cells: NDArray[np.integer]) -> Longs:
    """Return Morton codes of integer cells.

    Args:
        cells: ``[..., D]`` with ``D`` 2 or 3, each coordinate in ``[0, 2**31)`` or ``[0, 2**20)``.

    Returns:
        ``[...]`` int64 codes, ordered along the Z curve.
    """
    dimensions = cells.shape[-1]
    spread = SPREAD_2D if dimensions == 2 else SPREAD_3D
    code = np.zeros(cells.shape[:-1], np.int64)
    for axis in range(dimensions):
        bits = cells[..., axis].astype(np.int64)
        for shift, mask in spread:
            bits |= bits << shift  # in place: maps have millions of cells
            bits &= mask
        bits <<= axis
        code |= bits
    return code


def decode(codes: NDArray[np.integer], dimensions: int) -> Longs:
    """Return cells ``[..., D]`` of Morton codes ``[...]``; the inverse of :func:`encode`."""
    spread = SPREAD_2D if dimensions == 2 else SPREAD_3D
    shifts = [shift for shift, _ in spread]
    top = 0x00000000FFFFFFFF if dimensions == 2 else 0x00000000001FFFFF
    masks = [top, *(mask for _, mask in spread[:-1])]
    cells = np.empty((*codes.shape, dimensions), np.int64)
    for axis in range(dimensions):
        bits = (codes.astype(np.int64) >> axis) & spread[-1][1]
        for shift, mask in zip(reversed(shifts), reversed(masks), strict=True):
            bits = (bits | (bits >> shift)) & mask
        cells[..., axis] = bits
    return cells
