"""Columns of numbers as bytes that compress well: byte planes, bit planes, differences of codes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import MAX_LEVEL

FLOATS = ("<f2", "<f4")
"""Precisions in which long columns of floats are stored."""

LEVEL_BITS = MAX_LEVEL.bit_length()
"""Planes of bits that hold levels of evidence."""

MAX_CODE_BYTES = 6
"""Bytes of the widest difference between two neighbouring Morton codes."""


@dataclass(frozen=True)
class Column:
    """A shuffled column ``[N, *row]`` of a part, in one of several dtypes."""

    name: str
    dtypes: tuple[str, ...]  # of different sizes; where there are no rows, the first
    row: tuple[int, ...] = ()


SAMPLE_COLUMNS = (Column("points", ("<f4",), (3,)), Column("labels", FLOATS))


def feature_column(settings: FieldSettings) -> Column:
    """Feature vectors of vertices that are not integers."""
    return Column("features", FLOATS, (settings.feature_size,))


def moment_columns(settings: FieldSettings) -> tuple[Column, ...]:
    """Adam's state of vertices: first and second moments, and steps."""
    floats, row = ("<f4", "<f2"), (settings.feature_size,)
    return Column("means", floats, row), Column("variances", floats, row), Column("steps", ("<i4",))


def shuffle(array: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Bytes ``[B, ...]`` of an array ``[...]`` of ``B``-byte values, little endian.

    Row ``k`` holds byte ``k`` of every value: bytes of one significance resemble each other, so
    they compress better side by side.
    """
    little = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<"), copy=False)
    size = little.dtype.itemsize
    values = np.frombuffer(little.tobytes(), np.uint8).reshape(*array.shape, size)
    return np.ascontiguousarray(np.moveaxis(values, -1, 0))


def unshuffle(planes: NDArray[np.uint8], dtype: str) -> NDArray[np.generic]:
    """The inverse of :func:`shuffle`."""
    values = np.ascontiguousarray(np.moveaxis(planes, 0, -1))
    return np.frombuffer(values.data, dtype).reshape(planes.shape[1:])


def shuffle_codes(codes: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Shuffled differences ``[B, V]`` of increasing codes ``[V]``, in as few bytes as hold them."""
    return shuffle_counts(np.diff(codes, prepend=np.int64(0)))


def unshuffle_codes(planes: NDArray[np.uint8]) -> NDArray[np.int64]:
    """The inverse of :func:`shuffle_codes`; it takes at most ``MAX_CODE_BYTES`` rows.

    Differences this small cannot pass over the negative numbers, so that codes which overflow
    are seen to decrease.
    """
    return np.cumsum(unshuffle_counts(planes), dtype=np.int64)


def shuffle_counts(counts: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Shuffled numbers ``[B, V]`` that are not negative, in as few bytes as hold them all."""
    width = (int(counts.max(initial=1)).bit_length() + 7) // 8
    return shuffle(counts)[:width]


def unshuffle_counts(planes: NDArray[np.uint8]) -> NDArray[np.int64]:
    """The inverse of :func:`shuffle_counts`; it takes at most seven rows."""
    wide = np.zeros((8, planes.shape[1]), np.uint8)
    wide[: len(planes)] = planes
    return unshuffle(wide, "<i8").astype(np.int64)


def split_integers(integers: NDArray[np.int16]) -> NDArray[np.int8]:
    """Signed bytes ``[W, S, V]`` of integers ``[V, S]``, ``W`` being 1 where one byte holds all.

    Row 0 is the integer's remainder in -128 to 127, row 1 the multiple of 256 without it: unlike
    the upper byte of the two's complement, it is 0 for all small integers.
    """
    high = (integers.astype(np.int32) + 128) >> 8
    low = integers.astype(np.int32) - (high << 8)
    planes = [low, high] if high.any() else [low]
    return np.stack([plane.T for plane in planes]).astype(np.int8)


def join_integers(planes: NDArray[np.int8]) -> NDArray[np.int16]:
    """The inverse of :func:`split_integers`."""
    integers = planes[0].astype(np.int32)
    for plane in planes[1:]:
        integers += plane.astype(np.int32) << 8
    return np.ascontiguousarray(integers.T).astype(np.int16)


def split_levels(levels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Bits [LEVEL_BITS, N] of levels [S], highest bits first, ``N`` being ``S / 8`` rounded up.

    Each plane but the first is stored as its difference (xor) from the one above. Levels of
    neighbours are alike: two that differ by one differ in one stored bit, so that the planes shrink
    to a tenth less than bytes of one level each do.
    """
    bits = np.arange(LEVEL_BITS, dtype=np.uint8)[::-1, None]
    planes = np.packbits(levels >> bits & 1, axis=1, bitorder="little")
    planes[1:] ^= planes[:-1].copy()
    return planes


def join_levels(planes: NDArray[np.uint8], count: int) -> NDArray[np.uint8]:
    """``count`` levels; the inverse of :func:`split_levels`."""
    levels = np.zeros(count, np.uint8)
    for plane in np.bitwise_xor.accumulate(planes, axis=0):
        levels <<= 1
        levels |= np.unpackbits(plane, count=count, bitorder="little")
    return levels
