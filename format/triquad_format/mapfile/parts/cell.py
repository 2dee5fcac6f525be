"""The cells into which a region is split: squares of vertices and cubes of evidence."""

import numpy as np
from numpy.typing import NDArray

from triquad_format.mapfile.parts.part import EVIDENCE, VERTICES, PartKey
from triquad_format.records import morton
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.leaf_box import LeafBox, whole_region
from triquad_format.records.region import AXES, BLOCK_VOXELS

_LEAVES_LOG2 = 8

CELL_LEAVES = 1 << _LEAVES_LOG2
"""Side of a cell in leaves: 51.2 m."""


def square_shift(settings: FieldSettings, level: int) -> int:
    """Bits by which a vertex' code exceeds that of its square."""
    return 2 * (_LEAVES_LOG2 - (settings.depth - level))


def cube_shift() -> int:
    """Bits by which a block's code exceeds that of its cube."""
    return 3 * (_LEAVES_LOG2 - (BLOCK_VOXELS.bit_length() - 1))


def vertex_reach(settings: FieldSettings) -> int:
    """How far a vertex of the coarsest level is felt, leaves."""
    return 1 << (settings.feature_levels - 1)


def extent(settings: FieldSettings, key: PartKey) -> LeafBox:
    """The column over a square, or the cube, that a part is of; else all of its region."""
    box = whole_region(settings)
    axes = {VERTICES: list(AXES[key.plane]), EVIDENCE: [0, 1, 2]}.get(key.topic, [])
    if axes:
        cell = morton.decode(np.array([key.cell]), len(axes))[0]
        box.low[axes] = cell * CELL_LEAVES
        box.high[axes] = np.minimum((cell + 1) * CELL_LEAVES, 1 << settings.depth)
    return box


def cells_at(leaves: NDArray[np.int64]) -> set[int]:
    """Codes of the squares or cubes that hold places [N, 2 or 3]."""
    return set(np.unique(morton.encode(leaves >> _LEAVES_LOG2)).tolist())


def cells_near(leaves: NDArray[np.floating], reach: float) -> set[int]:
    """Codes of the squares or cubes within ``reach`` leaves of places [N, 2 or 3]."""
    cells: set[int] = set()
    for corner in np.ndindex(*(2,) * leaves.shape[1]):
        near = np.floor(leaves + (2 * np.array(corner) - 1) * reach).astype(np.int64)
        cells |= cells_at(np.maximum(near, 0))
    return cells
