"""The parts of a map file back into a map record; every field is checked as it is read."""

import dataclasses
import reprlib
import typing
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from triquad_format.array import ArraySpec, unpack_array
from triquad_format.errors import DamagedMapFileError, UnsupportedMapFileError
from triquad_format.field_settings import FieldSettings
from triquad_format.map_parts import (
    EVIDENCE,
    FRAME_ID,
    MANIFEST,
    MAP,
    MAX_CODE_BYTES,
    MOMENTS,
    REGION,
    SAMPLES,
    TRAINING,
    UNITS,
    VERTICES,
    Part,
    unshuffle,
    unshuffle_codes,
)
from triquad_format.region import (
    AXES,
    BLOCK_BYTES,
    Evidence,
    MapRecord,
    Mlp,
    Region,
    RegionIndex,
    TrainingState,
    VertexTable,
)

MAX_REGION_INDEX = 2**31 - 1
_LAYERS = 3
_MAX_ITEMS = 64
_MAX_PART_STRING_BYTES = 4096

_Columns = tuple[NDArray[Any], ...]
"""What one part, or all parts of a table together, hold of it: columns of equal length."""


class PartBody:
    """The decoded msgpack map of a part: typed access to its fields."""

    def __init__(self, part: Part, max_items: int = _MAX_ITEMS) -> None:
        self._topic = part.topic
        try:
            body = msgpack.unpackb(
                part.payload,
                max_str_len=_MAX_PART_STRING_BYTES,
                max_array_len=max_items,
                max_map_len=_MAX_ITEMS,
                max_ext_len=0,
            )
        except (ValueError, msgpack.exceptions.UnpackException, RecursionError) as error:
            raise DamagedMapFileError(f"{part.topic}: not a msgpack map: {error}") from error
        if not isinstance(body, dict):
            raise DamagedMapFileError(f"{part.topic}: not a map but a {type(body).__name__}")
        self._body = body

    def value(self, key: str, kind: type) -> Any:
        """The field ``key``, which must be exactly of the type ``kind``."""
        value = self._body.get(key)
        if type(value) is not kind:
            raise DamagedMapFileError(
                f"{self._topic}: {key} = {reprlib.repr(value)} is not {kind.__name__}",
            )
        return value

    def expect(self, key: str, wanted: object) -> None:
        """Refuse a part whose field ``key`` is not ``wanted``."""
        value = self.value(key, type(wanted))
        if value != wanted:
            raise DamagedMapFileError(f"{self._topic}: {key} = {value!r}, expected {wanted!r}")

    def count(self, key: str) -> int:
        """A number in ``[0, 2**63)``."""
        value: int = self.value(key, int)
        if not 0 <= value < 2**63:
            raise DamagedMapFileError(f"{self._topic}: {key} = {value} is not a count")
        return value

    def counts(self, key: str, length: int) -> list[int]:
        """A list of ``length`` numbers in ``[0, 2**63)``."""
        values: list[Any] = self.value(key, list)
        if len(values) != length or not all(
            type(value) is int and 0 <= value < 2**63 for value in values
        ):
            raise DamagedMapFileError(
                f"{self._topic}: {key} = {reprlib.repr(values)} is not a list of {length} counts",
            )
        return values

    def index(self) -> RegionIndex:
        """The index of the region to which the part belongs."""
        value = self.value("region", list)
        if len(value) != 3 or not all(
            type(number) is int and abs(number) <= MAX_REGION_INDEX for number in value
        ):
            raise DamagedMapFileError(
                f"{self._topic}: region = {reprlib.repr(value)} is not an index"
            )
        return (value[0], value[1], value[2])

    def array(self, key: str, dtype: str, *shape: int | None) -> NDArray[Any]:
        """An array of this dtype and shape (``None``: any size)."""
        return self._array(f"{self._topic}: {key}", self._body.get(key), ArraySpec(dtype, shape))

    def arrays(self, key: str, count: int) -> tuple[NDArray[Any], ...]:
        """``count`` arrays of ``<f4``, each of any shape of one or two axes."""
        items = self.value(key, list)
        if len(items) != count:
            raise DamagedMapFileError(
                f"{self._topic}: {key} holds {len(items)} arrays, not {count}"
            )
        return tuple(
            self._array(f"{self._topic}: {key}[{i}]", item, None) for i, item in enumerate(items)
        )

    def codes(self, key: str) -> NDArray[np.int64]:
        """Morton codes [V]."""
        planes = self.array(key, "|u1", None, None)
        if not 1 <= len(planes) <= MAX_CODE_BYTES:
            raise DamagedMapFileError(f"{self._topic}: {key} has {len(planes)} bytes per code")
        return unshuffle_codes(planes)

    def floats(self, key: str, *shape: int | None) -> NDArray[Any]:
        """A shuffled array of ``<f2`` or ``<f4``."""
        planes = self.array(key, "|u1", None, *shape)
        if len(planes) not in (2, 4):
            raise DamagedMapFileError(f"{self._topic}: {key} has {len(planes)} bytes per value")
        return unshuffle(planes, f"<f{len(planes)}")

    @staticmethod
    def _array(name: str, packed: object, spec: ArraySpec | None) -> NDArray[Any]:
        array = unpack_array(name, packed)
        (spec or ArraySpec("<f4", (None,) * array.ndim)).check(name, array)
        return array

    def mapping(self, key: str) -> Mapping[str, object]:
        """A nested map."""
        value: Mapping[str, object] = self.value(key, dict)
        return value


class PartCursor:
    """Takes parts one after the other, in the order that the format demands."""

    def __init__(self, parts: Iterator[Part]) -> None:
        self._parts = parts

    def take(self, topic: str, max_items: int = _MAX_ITEMS) -> PartBody:
        """The body of the next part, which must be of this topic."""
        part = next(self._parts, None)
        if part is None:
            raise DamagedMapFileError(f"the part {topic} is missing at the end")
        if part.topic != topic:
            raise DamagedMapFileError(f"expected the part {topic}, found {part.topic}")
        return PartBody(part, max_items)

    def finish(self) -> None:
        """Refuse any further part."""
        part = next(self._parts, None)
        if part is not None:
            raise DamagedMapFileError(f"the part {part.topic} follows the manifest")


def unpack_record(cursor: PartCursor) -> MapRecord:
    """The record in the parts up to the manifest; shapes against settings are not yet checked.

    Raises:
        FormatError: a part is missing, misplaced or malformed.
    """
    body = cursor.take(MAP)
    for key, wanted in (("frame_id", FRAME_ID), ("units", UNITS)):
        if body.value(key, str) != wanted:
            raise UnsupportedMapFileError(f"{key} = {body.value(key, str)!r}, not {wanted!r}")
    settings = _unpack_settings(body.mapping("settings"))
    regions = tuple(_unpack_region(cursor, settings) for _ in range(body.count("regions")))
    return MapRecord(body.value("name", str), body.count("epoch"), settings, regions)


def unpack_manifest(cursor: PartCursor, max_parts: int) -> list[tuple[str, int, bytes]]:
    """Topic, length and SHA-256 of every part before the manifest."""
    entries = cursor.take(MANIFEST, max(max_parts, _MAX_ITEMS)).value("parts", list)
    try:
        return [(entry["topic"], entry["bytes"], entry["sha256"]) for entry in entries]
    except (TypeError, KeyError) as error:
        raise DamagedMapFileError(f"{MANIFEST}: an entry is malformed: {error}") from error


def _unpack_settings(body: Mapping[str, object]) -> FieldSettings:
    hints = typing.get_type_hints(FieldSettings)
    values: dict[str, Any] = {}
    for field in dataclasses.fields(FieldSettings):
        value = body.get(field.name)
        if hints[field.name] is float and type(value) is int and abs(value) < 2**53:
            value = float(value)
        if type(value) is not hints[field.name]:
            raise DamagedMapFileError(f"{MAP}: setting {field.name} = {reprlib.repr(value)}")
        values[field.name] = value
    return FieldSettings(**values)


def _unpack_region(cursor: PartCursor, settings: FieldSettings) -> Region:
    body = cursor.take(REGION)
    index = body.index()
    places = [(plane, level) for plane in range(len(AXES)) for level in settings.levels]
    counts = body.counts("vertices", len(places))
    tables = tuple(
        _unpack_table(cursor, index, place, count)
        for place, count in zip(places, counts, strict=True)
    )
    evidence = _unpack_evidence(cursor, index, body.count("blocks"))
    training = None
    if body.value("training", bool):
        training = _unpack_training(cursor, index, places, counts)
    return Region(
        index=index,
        frequencies=body.array("frequencies", "<f4", None),
        mlp=Mlp(body.arrays("weights", _LAYERS), body.arrays("biases", _LAYERS)),
        tables=tables,
        evidence=evidence,
        training=training,
    )


def _take_of_region(cursor: PartCursor, topic: str, index: RegionIndex) -> PartBody:
    body = cursor.take(topic)
    if body.index() != index:
        raise DamagedMapFileError(f"{topic}: of region {body.index()}, expected {index}")
    return body


def _take_rows(
    cursor: PartCursor,
    topic: str,
    index: RegionIndex,
    count: int,
    read: Callable[[PartBody], _Columns],
) -> _Columns:
    """The columns of a table of ``count`` rows, from as many parts as it was split into."""
    portions: list[_Columns] = []
    found = 0
    while not portions or found < count:
        columns = read(_take_of_region(cursor, topic, index))
        rows = len(columns[0])
        if any(len(column) != rows for column in columns):
            raise DamagedMapFileError(f"{topic}: columns of region {index} differ in length")
        if portions and (rows == 0 or _kinds(columns) != _kinds(portions[0])):
            raise DamagedMapFileError(f"{topic}: a part of region {index} does not fit the first")
        portions.append(columns)
        found += rows
    if found != count:
        raise DamagedMapFileError(f"{topic}: region {index} has {found} rows, not {count}")
    if len(portions) == 1:
        return portions[0]
    return tuple(np.concatenate(column) for column in zip(*portions, strict=True))


def _kinds(columns: _Columns) -> list[tuple[np.dtype[Any], tuple[int, ...]]]:
    return [(column.dtype, column.shape[1:]) for column in columns]


def _unpack_table(
    cursor: PartCursor, index: RegionIndex, place: tuple[int, int], count: int
) -> VertexTable:
    def read(body: PartBody) -> _Columns:
        _expect_place(body, place)
        return body.codes("codes"), body.floats("features", None, None)

    return VertexTable(*place, *_take_rows(cursor, VERTICES, index, count, read))


def _unpack_evidence(cursor: PartCursor, index: RegionIndex, count: int) -> Evidence:
    def read(body: PartBody) -> _Columns:
        masks = [body.array(key, "|u1", None, BLOCK_BYTES) for key in ("surface", "free")]
        return body.codes("codes"), *masks

    return Evidence(*_take_rows(cursor, EVIDENCE, index, count, read))


def _unpack_training(
    cursor: PartCursor,
    index: RegionIndex,
    places: list[tuple[int, int]],
    counts: list[int],
) -> TrainingState:
    body = _take_of_region(cursor, TRAINING, index)
    moments = [
        _unpack_moments(cursor, index, place, count)
        for place, count in zip(places, counts, strict=True)
    ]
    points, labels = _unpack_samples(cursor, index, body.count("samples"))
    return TrainingState(
        table_means=tuple(columns[0] for columns in moments),
        table_variances=tuple(columns[1] for columns in moments),
        table_steps=tuple(columns[2] for columns in moments),
        mlp_means=body.arrays("mlp_means", 2 * _LAYERS),
        mlp_variances=body.arrays("mlp_variances", 2 * _LAYERS),
        mlp_steps=body.count("mlp_steps"),
        sample_points=points,
        sample_labels=labels,
        visits_owed=body.count("visits_owed"),
    )


def _unpack_moments(
    cursor: PartCursor, index: RegionIndex, place: tuple[int, int], count: int
) -> _Columns:
    def read(body: PartBody) -> _Columns:
        _expect_place(body, place)
        means, variances = (body.floats(key, None, None) for key in ("means", "variances"))
        return means, variances, unshuffle(body.array("steps", "|u1", 4, None), "<i4")

    return _take_rows(cursor, MOMENTS, index, count, read)


def _expect_place(body: PartBody, place: tuple[int, int]) -> None:
    """Refuse a part of another plane or level."""
    body.expect("plane", place[0])
    body.expect("level", place[1])


def _unpack_samples(cursor: PartCursor, index: RegionIndex, count: int) -> _Columns:
    def read(body: PartBody) -> _Columns:
        points = unshuffle(body.array("points", "|u1", 4, None, 3), "<f4")
        return points, body.floats("labels", None)

    return _take_rows(cursor, SAMPLES, index, count, read)
