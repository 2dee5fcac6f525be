"""The msgpack map of a part, read with every field checked."""

import reprlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triquad_format.errors import DamagedMapFileError, WireError
from triquad_format.mapfile.parts.part import (
    MAX_CODE_BYTES,
    Column,
    join_integers,
    unshuffle,
    unshuffle_counts,
)
from triquad_format.records.arrays import Longs
from triquad_format.records.field_settings import RegionIndex
from triquad_format.wire.packing import ArraySpec, unpack_array, unpacked

_MAX_REGION_INDEX = 2**31 - 1


def unpack_body(topic: str, payload: bytes) -> "PartBody":
    """Return the body of a part.

    Raises:
        DamagedMapFileError: it is not a msgpack map, exceeds a limit, or is of another topic.
    """
    try:
        part = PartBody(topic, unpacked(payload))
    except WireError as error:
        raise DamagedMapFileError(f"{topic}: {error}") from error
    part.expect("topic", topic)
    return part


class PartBody:
    """A msgpack map in a part, with typed access to its fields.

    Every method raises :class:`~triquad_format.errors.FormatError` where a field is missing or
    malformed; the text names topic, field and value.
    """

    def __init__(self, topic: str, body: object) -> None:
        """Take a decoded body; ``topic`` is for messages."""
        if not isinstance(body, dict):
            raise DamagedMapFileError(f"{topic}: not a map but a {type(body).__name__}")
        self.topic = topic
        self._body: Mapping[str, object] = body

    def value(self, key: str, kind: type) -> Any:
        """Return the field ``key``, which must be exactly of the type ``kind``."""
        value = self._body.get(key)
        if type(value) is not kind:
            raise DamagedMapFileError(
                f"{self.topic}: {key} = {reprlib.repr(value)} is not {kind.__name__}",
            )
        return value

    def expect(self, key: str, wanted: object) -> None:
        """Refuse a part whose field ``key`` is not ``wanted``."""
        value = self.value(key, type(wanted))
        if value != wanted:
            raise DamagedMapFileError(f"{self.topic}: {key} = {value!r}, expected {wanted!r}")

    def count(self, key: str) -> int:
        """Return a number in ``[0, 2**63)``."""
        value: int = self.value(key, int)
        if not 0 <= value < 2**63:
            raise DamagedMapFileError(f"{self.topic}: {key} = {value} is not a count")
        return value

    def texts(self, key: str) -> list[str]:
        """Return a list of strings."""
        values: list[Any] = self.value(key, list)
        if not all(type(value) is str for value in values):
            raise DamagedMapFileError(f"{self.topic}: {key} is not a list of strings")
        return values

    def index(self) -> RegionIndex:
        """Return the index of the region to which the part belongs."""
        value = self.value("region", list)
        if len(value) != 3 or not all(
            type(number) is int and abs(number) <= _MAX_REGION_INDEX for number in value
        ):
            raise DamagedMapFileError(
                f"{self.topic}: region = {reprlib.repr(value)} is not an index"
            )
        return (value[0], value[1], value[2])

    def array(self, key: str, dtype: str, shape: tuple[int | None, ...]) -> NDArray[Any]:
        """Return an array of this dtype and shape; a size that is ``None`` may be any.

        It can be written to: kernels are compiled for such arrays, and would be again for others.
        """
        name = f"{self.topic}: {key}"
        array = unpack_array(name, self._body.get(key))
        ArraySpec(dtype, shape).check(name, array)
        return np.array(array)

    def arrays(self, key: str, count: int) -> tuple[NDArray[Any], ...]:
        """Return ``count`` arrays of ``<f4``, each of any shape, as :meth:`array` does."""
        arrays = []
        for i, item in enumerate(self._items(key, count)):
            name = f"{self.topic}: {key}[{i}]"
            array = unpack_array(name, item)
            ArraySpec("<f4", (None,) * array.ndim).check(name, array)
            arrays.append(np.array(array))
        return tuple(arrays)

    def mapping(self, key: str) -> Mapping[str, object]:
        """Return a nested map."""
        value: Mapping[str, object] = self.value(key, dict)
        return value

    def maps(self, key: str, count: int) -> tuple["PartBody", ...]:
        """Return ``count`` nested maps."""
        return tuple(PartBody(self.topic, item) for item in self._items(key, count))

    def codes(self, key: str, most: int) -> Longs:
        """Return Morton codes [V], of which at most ``most`` are decoded: each takes 8 bytes."""
        # Differences as small as counts cannot pass over the negative numbers, so that codes which
        # overflow are seen to decrease.
        return np.cumsum(self.counts(key, None, most), dtype=np.int64)

    def counts(self, key: str, count: int | None, most: int) -> Longs:
        """Return numbers that are not negative: ``count`` of them, ``None``: any up to ``most``."""
        planes = self.array(key, "|u1", (None, count))
        self._limit(key, planes.shape[1], most)
        if not 1 <= len(planes) <= MAX_CODE_BYTES:
            raise DamagedMapFileError(f"{self.topic}: {key} has {len(planes)} bytes per number")
        return unshuffle_counts(planes)

    def column(self, column: Column, count: int | None) -> NDArray[Any]:
        """Return a shuffled column of ``count`` rows; ``None``: of any number."""
        planes = self.array(column.name, "|u1", (None, count, *column.row))
        for dtype in column.dtypes:
            if np.dtype(dtype).itemsize == len(planes):
                return unshuffle(planes, dtype)
        raise DamagedMapFileError(f"{self.topic}: {column.name} has {len(planes)} bytes per value")

    def columns(self, columns: Sequence[Column], most: int) -> tuple[NDArray[Any], ...]:
        """Return shuffled columns of equal length, which is at most ``most``."""
        first = self.column(columns[0], None)
        self._limit(columns[0].name, len(first), most)
        return (first, *(self.column(column, len(first)) for column in columns[1:]))

    def integers(self, key: str, count: int, size: int) -> NDArray[np.int16]:
        """Return integers [count, size] of one or two bytes."""
        planes = self.array(key, "|i1", (None, size, count))
        if len(planes) not in (1, 2):
            raise DamagedMapFileError(f"{self.topic}: {key} has {len(planes)} bytes per value")
        return join_integers(planes)

    def has(self, key: str) -> bool:
        """Return whether there is a field ``key``."""
        return key in self._body

    def _items(self, key: str, count: int) -> list[Any]:
        items: list[Any] = self.value(key, list)
        if len(items) != count:
            raise DamagedMapFileError(f"{self.topic}: {key} holds {len(items)} items, not {count}")
        return items

    def _limit(self, key: str, count: int, most: int) -> None:
        """Refuse a field of more than ``most`` rows."""
        if count > most:
            raise DamagedMapFileError(f"{self.topic}: {key} has {count} rows, above {most}")
