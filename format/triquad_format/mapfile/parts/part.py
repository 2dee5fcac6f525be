"""The parts of a map file: their topics and keys, and the cells into which a region is split.

The field and the evidence of a region are split into cells, so that few of its parts change from
checkpoint to checkpoint: vertices into squares of a plane, evidence into cubes.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from triquad_format.records import morton
from triquad_format.records.crop import LeafBox, whole_region
from triquad_format.records.field_settings import BLOCK_VOXELS, FieldSettings, RegionIndex
from triquad_format.records.region import AXES

PREFIX = "/triquad/"
MAP = "/triquad/map"
REGION = "/triquad/region"
VERTICES = "/triquad/vertices"
EVIDENCE = "/triquad/evidence"
TRAINING = "/triquad/training"
MOMENTS = "/triquad/moments"
SAMPLES = "/triquad/samples"
MANIFEST = "/triquad/manifest"
PREVIEW = "/preview/mesh"

FIELD_TOPICS = (REGION, VERTICES, EVIDENCE)
TRAINING_TOPICS = (TRAINING, MOMENTS, SAMPLES)
REGION_TOPICS = (*FIELD_TOPICS, *TRAINING_TOPICS)
TOPICS = (MAP, *REGION_TOPICS, MANIFEST)

MESSAGE_ENCODING = "msgpack"
PREVIEW_ENCODING = "protobuf"
PREVIEW_SCHEMA = "foxglove.SceneUpdate"

ENCODINGS = {
    **dict.fromkeys((MAP, *REGION_TOPICS), MESSAGE_ENCODING),
    PREVIEW: PREVIEW_ENCODING,
    MANIFEST: MESSAGE_ENCODING,
}
"""How the messages of each topic are encoded; topics in the order of their channels' numbers."""

MAX_PART_BYTES = 32 * 2**20 - 65_536

NO_REGION: RegionIndex = (0, 0, 0)

_LEAVES_LOG2 = 8

CELL_LEAVES = 1 << _LEAVES_LOG2
"""Side of a cell in leaves: 51.2 m at the default leaf."""


@dataclass(frozen=True, order=True)
class PartKey:
    """What a part is of; no two parts of a map have the same key."""

    topic: str
    region: RegionIndex = NO_REGION  # also of what belongs to the whole map
    plane: int = 0  # of vertices and moments
    cell: int = 0  # Morton code of a square or cube; number of a portion of samples


@dataclass(frozen=True)
class Part:
    """One part, packed."""

    key: PartKey
    payload: bytes


def square_shift(settings: FieldSettings, level: int) -> int:
    """Bits by which the code of a vertex of a level is longer than that of its square."""
    return 2 * (_LEAVES_LOG2 - (settings.depth - level))


def cube_shift() -> int:
    """Bits by which the code of a block is longer than that of its cube."""
    return 3 * (_LEAVES_LOG2 - (BLOCK_VOXELS.bit_length() - 1))


def vertex_reach(settings: FieldSettings) -> int:
    """How far a vertex of the coarsest level has an effect, leaves."""
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
    """Codes of the squares or cubes that hold places [N, 2 or 3], in leaf coordinates."""
    return set(np.unique(morton.encode(leaves >> _LEAVES_LOG2)).tolist())


def cells_near(leaves: NDArray[np.floating], reach: float) -> set[int]:
    """Codes of the squares or cubes within ``reach`` leaves of places [N, 2 or 3] in leaves."""
    cells: set[int] = set()
    for corner in np.ndindex(*(2,) * leaves.shape[1]):
        near = np.floor(leaves + (2 * np.array(corner) - 1) * reach).astype(np.int64)
        cells |= cells_at(np.maximum(near, 0))
    return cells
