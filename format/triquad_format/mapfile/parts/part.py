"""The parts of a map file: topics and keys, cells of a region, and columns as bytes.

The field and the evidence of a region are split into cells, so that few of its parts change from
checkpoint to checkpoint: vertices into squares of a plane, evidence into cubes. Columns of numbers
are stored as they compress well: in byte planes, bit planes, and differences of codes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from triquad_format.records import morton
from triquad_format.records.arrays import Bytes, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS, FieldSettings, RegionIndex
from triquad_format.records.leaf_box import LeafBox, whole_region
from triquad_format.records.region import AXES, FLOATS, MAX_LEVEL

PREFIX = "/triquad/"
MAP = "/triquad/map"
REGION = "/triquad/region"
VERTICES = "/triquad/vertices"
EVIDENCE = "/triquad/evidence"
TRAINING = "/triquad/training"
MOMENTS = "/triquad/moments"
SAMPLES = "/triquad/samples"
RAYS = "/triquad/rays"
MANIFEST = "/triquad/manifest"
PREVIEW = "/preview/mesh"

FIELD_TOPICS = (REGION, VERTICES, EVIDENCE)
TRAINING_TOPICS = (TRAINING, MOMENTS, SAMPLES, RAYS)
REGION_TOPICS = (*FIELD_TOPICS, *TRAINING_TOPICS)
MESSAGE_ENCODING = "msgpack-zstd"
PREVIEW_ENCODING = "protobuf"
PREVIEW_SCHEMA = "foxglove.SceneUpdate"

MAX_PART_BYTES = 32 * 2**20 - 65_536
"""Bytes of the largest payload."""

NO_REGION: RegionIndex = (0, 0, 0)

_LEAVES_LOG2 = 8

CELL_LEAVES = 1 << _LEAVES_LOG2
"""Side of a cell in leaves: 51.2 m at the default leaf."""

LEVEL_BITS = MAX_LEVEL.bit_length()
"""The number of bit planes for levels of evidence."""

MAX_CODE_BYTES = 6
"""Bytes of the widest count, or difference between two neighbouring Morton codes."""


@dataclass(frozen=True, order=True)
class PartKey:
    """The key of a part; no two parts of a map have the same one."""

    topic: str
    region: RegionIndex = NO_REGION  # also of what belongs to the whole map
    plane: int = 0  # of vertices and moments; number of a portion of the rays of a cube
    cell: int = 0  # Morton code of a square or cube; number of a portion of samples


@dataclass(frozen=True)
class Part:
    """One part, packed."""

    key: PartKey
    payload: bytes


def square_shift(settings: FieldSettings, level: int) -> int:
    """Return how many bits a vertex's code at a level is longer than that of its square."""
    return 2 * (_LEAVES_LOG2 - (settings.depth - level))


def cube_shift() -> int:
    """Return how many bits a block's code is longer than that of its cube."""
    return 3 * (_LEAVES_LOG2 - (BLOCK_VOXELS.bit_length() - 1))


def leaf_shift() -> int:
    """Return how many bits a leaf's code is longer than that of its cube."""
    return 3 * _LEAVES_LOG2


def vertex_reach(settings: FieldSettings) -> int:
    """Return how far a vertex of the coarsest level has an effect, leaves."""
    return 1 << (settings.feature_levels - 1)


def extent(settings: FieldSettings, key: PartKey) -> LeafBox:
    """Return the column over a part's square, or its cube; else all of its region: leaves."""
    box = whole_region(settings)
    axes = {VERTICES: list(AXES[key.plane]), EVIDENCE: [0, 1, 2]}.get(key.topic, [])
    if axes:
        cell = morton.decode(np.array([key.cell]), len(axes))[0]
        box.low[axes] = cell * CELL_LEAVES
        box.high[axes] = np.minimum((cell + 1) * CELL_LEAVES, 1 << settings.depth)
    return box


@dataclass(frozen=True)
class Column:
    """A shuffled column ``[N, *row]`` of a part, in one of several dtypes."""

    name: str
    dtypes: tuple[str, ...]  # of different sizes; where there are no rows, the first
    row: tuple[int, ...] = ()


SAMPLE_COLUMNS = (Column("points", ("<f4",), (3,)), Column("labels", FLOATS))


def feature_column(settings: FieldSettings) -> Column:
    """Return feature vectors of vertices that are not integers."""
    return Column("features", FLOATS, (settings.feature_size,))


def moment_columns(settings: FieldSettings) -> tuple[Column, ...]:
    """Return Adam's state of vertices: first and second moments, and steps."""
    floats, row = ("<f4", "<f2"), (settings.feature_size,)
    return Column("means", floats, row), Column("variances", floats, row), Column("steps", ("<i4",))


def shuffle(array: NDArray[np.generic]) -> Bytes:
    """Return bytes ``[B, ...]`` of an array ``[...]`` of ``B``-byte values, little endian.

    Row ``k`` is byte ``k`` of every value: bytes of one significance resemble each other, so
    they compress better side by side.
    """
    little = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<"), copy=False)
    size = little.dtype.itemsize
    values = np.frombuffer(little.tobytes(), np.uint8).reshape(*array.shape, size)
    return np.ascontiguousarray(np.moveaxis(values, -1, 0))


def unshuffle(planes: Bytes, dtype: str) -> NDArray[np.generic]:
    """Return the array ``[...]`` of this dtype; the inverse of :func:`shuffle`."""
    values = np.ascontiguousarray(np.moveaxis(planes, 0, -1))
    return np.frombuffer(values.data, dtype).reshape(planes.shape[1:])


def shuffle_codes(codes: Longs) -> Bytes:
    """Return shuffled differences ``[B, V]`` of increasing codes ``[V]``, in the fewest bytes."""
    return shuffle_counts(np.diff(codes, prepend=np.int64(0)))


def shuffle_counts(counts: Longs) -> Bytes:
    """Return shuffled numbers ``[B, V]`` that are not negative, in as few bytes as they all fit."""
    width = (int(counts.max(initial=1)).bit_length() + 7) // 8
    narrow = next(size for size in (1, 2, 4, 8) if size >= width)
    return shuffle(counts.astype(f"<u{narrow}"))[:width]


def unshuffle_counts(planes: Bytes) -> Longs:
    """Invert :func:`shuffle_counts`; it takes at most seven rows."""
    counts = np.zeros(planes.shape[1], np.int64)
    for plane in planes[::-1]:
        counts <<= 8
        counts |= plane
    return counts


def split_integers(integers: NDArray[np.int16]) -> NDArray[np.int8]:
    """Return signed bytes ``[W, S, V]`` of integers ``[V, S]``, ``W`` being 1 where each fits one.

    Row 0 is the integer's remainder in -128 to 127, row 1 the multiple of 256 without it: unlike
    the upper byte of the two's complement, it is 0 for all small integers.
    """
    high = (integers.astype(np.int32) + 128) >> 8
    low = integers.astype(np.int32) - (high << 8)
    planes = [low, high] if high.any() else [low]
    return np.stack([plane.T for plane in planes]).astype(np.int8)


def join_integers(planes: NDArray[np.int8]) -> NDArray[np.int16]:
    """Return integers ``[V, S]``; the inverse of :func:`split_integers`."""
    integers = planes[0].astype(np.int32)
    for plane in planes[1:]:
        integers += plane.astype(np.int32) << 8
    return np.ascontiguousarray(integers.T).astype(np.int16)


def split_bits(numbers: Bytes, width: int) -> Bytes:
    """Return bits [width, N] of small numbers [S], highest first; ``N`` is ``S / 8`` rounded up.

    Each plane but the first is stored as its difference (xor) from the one above. Levels of
    neighbours are alike: two that differ by one differ in one stored bit, so that the planes shrink
    to a tenth less than bytes of one level each do.
    """
    bits = np.arange(width, dtype=np.uint8)[::-1, None]
    planes = np.packbits(numbers >> bits & 1, axis=1, bitorder="little")
    planes[1:] ^= planes[:-1].copy()
    return planes


def join_bits(planes: Bytes, count: int) -> Bytes:
    """Return ``count`` numbers; the inverse of :func:`split_bits`."""
    numbers = np.zeros(count, np.uint8)
    above = np.zeros(planes.shape[1], np.uint8)
    for plane in planes:
        above ^= plane
        numbers <<= 1
        numbers |= np.unpackbits(above, count=count, bitorder="little")
    return numbers


def split_codes(codes: Bytes, widths: Sequence[int]) -> Bytes:
    """Return planes [sum of ``widths``, N] of codes [S, C], one column after the other."""
    columns = zip(codes.T, widths, strict=True)
    return np.concatenate([split_bits(column, width) for column, width in columns])


def join_codes(planes: Bytes, widths: Sequence[int], count: int) -> Bytes:
    """Return codes [count, C]; the inverse of :func:`split_codes`."""
    columns = np.split(planes, np.cumsum(widths)[:-1])
    return np.stack([join_bits(column, count) for column in columns], axis=1)
