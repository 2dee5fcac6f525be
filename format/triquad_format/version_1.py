"""Map files of version 1: a fixed sequence of parts. They are read, and no longer written.

``docs/map-file-version-1.md`` is their specification.
"""

import hashlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triquad_format.errors import DamagedMapFileError
from triquad_format.mapfile.map_facts import unpack_facts
from triquad_format.mapfile.mcap.records import MAX_CHUNK_BYTES, Message
from triquad_format.mapfile.parts.part import (
    EVIDENCE,
    MANIFEST,
    MAP,
    MOMENTS,
    REGION,
    SAMPLES,
    TOPICS,
    TRAINING,
    VERTICES,
)
from triquad_format.mapfile.parts.part_body import MAX_ITEMS, PartBody
from triquad_format.mapfile.parts.shuffle import unshuffle
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import (
    AXES,
    BLOCK_BYTES,
    MLP_LAYERS,
    Evidence,
    MapRecord,
    Mlp,
    Region,
    RegionIndex,
    TrainingState,
    VertexTable,
)

MAX_PART_BYTES = MAX_CHUNK_BYTES - 65_536

_Columns = tuple[NDArray[Any], ...]
"""What one part, or all parts of a table together, hold of it: columns of equal length."""


def read_record(parts: Iterator[Message]) -> MapRecord:
    """The record in all parts of a file, the manifest included.

    Shapes are not yet checked against the settings.

    Raises:
        FormatError: a part is missing, misplaced, malformed or not the one listed.
    """
    cursor = PartCursor(parts)
    body = cursor.take(MAP)
    facts = unpack_facts(body)
    regions = tuple(unpack_region(cursor, facts.settings) for _ in range(body.count("regions")))
    passed = cursor.passed.copy()
    listed = _unpack_manifest(cursor)
    cursor.finish()
    # Parts on unknown topics may stand before the manifest.
    passed += cursor.passed[len(passed) : -1]
    for number, (have, want) in enumerate(zip(passed, listed, strict=False)):
        if have != want:
            raise DamagedMapFileError(
                f"part {number}, {have[0]:.80}, is not the one that the manifest lists there",
            )
    if len(passed) != len(listed):
        raise DamagedMapFileError(f"{len(passed)} parts, but its manifest lists {len(listed)}")
    return MapRecord(facts.name, facts.epoch, facts.settings, regions)


class PartCursor:
    """Takes parts one after the other, in the order that the format demands."""

    def __init__(self, parts: Iterator[Message]) -> None:
        self._parts = parts
        self.passed: list[tuple[str, int, bytes]] = []  # topic, length, SHA-256

    def take(self, topic: str) -> PartBody:
        """The body of the next part, which must be of this topic."""
        message = self._next()
        if message is None:
            raise DamagedMapFileError(f"the part {topic} is missing at the end")
        if message.topic != topic:
            raise DamagedMapFileError(f"expected the part {topic}, found {message.topic}")
        return PartBody(topic, message.data, max(MAX_ITEMS, len(self.passed)))

    def finish(self) -> None:
        """Refuse any further part."""
        message = self._next()
        if message is not None:
            raise DamagedMapFileError(f"the part {message.topic} follows the manifest")

    def _next(self) -> Message | None:
        """The next part of a known topic."""
        for message in self._parts:
            digest = hashlib.sha256(message.data).digest()
            self.passed.append((message.topic, len(message.data), digest))
            if message.topic in TOPICS:
                return message
        return None


def _unpack_manifest(cursor: PartCursor) -> list[tuple[str, int, bytes]]:
    """Topic, length and SHA-256 of every part before the manifest."""
    entries = cursor.take(MANIFEST).value("parts", list)
    try:
        return [(entry["topic"], entry["bytes"], entry["sha256"]) for entry in entries]
    except (TypeError, KeyError) as error:
        raise DamagedMapFileError(f"{MANIFEST}: an entry is malformed: {error}") from error


def unpack_region(
    cursor: PartCursor, settings: FieldSettings, *, evidence: bool = True, training: bool = True
) -> Region:
    """The region whose parts come next.

    Args:
        cursor: the parts.
        settings: of the map.
        evidence: whether its parts are there; else the region has seen nothing.
        training: whether the parts of the training state are there, if the region has any.

    Raises:
        FormatError: a part is missing, misplaced or malformed.
    """
    body = cursor.take(REGION)
    index = body.index()
    places = [(plane, level) for plane in range(len(AXES)) for level in settings.levels]
    counts = body.counts("vertices", len(places))
    tables = tuple(
        _unpack_table(cursor, index, place, count)
        for place, count in zip(places, counts, strict=True)
    )
    seen = _nothing_seen()
    if evidence:
        seen = _unpack_evidence(cursor, index, body.count("blocks"))
    state = None
    if body.value("training", bool) and training:
        state = _unpack_training(cursor, index, places, counts)
    return Region(
        index=index,
        frequencies=body.array("frequencies", "<f4", None),
        mlp=Mlp(body.arrays("weights", MLP_LAYERS), body.arrays("biases", MLP_LAYERS)),
        tables=tables,
        evidence=seen,
        training=state,
    )


def _nothing_seen() -> Evidence:
    masks = np.zeros((0, BLOCK_BYTES), np.uint8)
    return Evidence(np.zeros(0, np.int64), masks, masks)


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
    most = min(count, ((1 << place[1]) + 1) ** 2)

    def read(body: PartBody) -> _Columns:
        _expect_place(body, place)
        codes = body.codes("codes", most)
        return codes, body.floats("features", len(codes), None)

    codes, features = _take_rows(cursor, VERTICES, index, count, read)
    return VertexTable(*place, codes, features)


def _unpack_evidence(cursor: PartCursor, index: RegionIndex, count: int) -> Evidence:
    def read(body: PartBody) -> _Columns:
        masks = [body.array(key, "|u1", None, BLOCK_BYTES) for key in ("surface", "free")]
        return body.codes("codes", len(masks[0])), *masks

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
        mlp_means=body.arrays("mlp_means", 2 * MLP_LAYERS),
        mlp_variances=body.arrays("mlp_variances", 2 * MLP_LAYERS),
        mlp_steps=body.count("mlp_steps"),
        sample_points=points,
        sample_labels=labels,
        budget_samples=body.count("visits_owed"),
    )


def _unpack_moments(
    cursor: PartCursor, index: RegionIndex, place: tuple[int, int], count: int
) -> _Columns:
    def read(body: PartBody) -> _Columns:
        _expect_place(body, place)
        steps = body.array("steps", "|u1", 4, None)
        rows = steps.shape[1]
        means, variances = (body.floats(key, rows, None) for key in ("means", "variances"))
        return means, variances, unshuffle(steps, "<i4")

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
