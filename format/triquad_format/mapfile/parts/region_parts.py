"""A region from its parts."""

from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from triquad_format.errors import DamagedMapFileError
from triquad_format.mapfile.parts.body import unpack_body
from triquad_format.mapfile.parts.part import (
    EVIDENCE,
    MOMENTS,
    REGION,
    SAMPLES,
    TRAINING,
    VERTICES,
    PartKey,
)
from triquad_format.mapfile.parts.unpack import (
    COLUMN_TOPICS,
    Columns,
    RegionHead,
    TrainingHead,
    read_columns,
    read_evidence,
    read_head,
    read_training_head,
)
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import (
    AXES,
    BLOCK_BYTES,
    Evidence,
    Region,
    RegionIndex,
    TrainingState,
    VertexTable,
    surface_counts,
)

_Integer = TypeVar("_Integer", bound=np.integer)


class RegionParts:
    """The parts of one region, gathered in any order."""

    def __init__(self, index: RegionIndex, settings: FieldSettings) -> None:
        self._index = index
        self._settings = settings
        self._head: RegionHead | None = None
        self._training: TrainingHead | None = None
        self._cubes: dict[int, Evidence] = {}
        self._columns: dict[PartKey, tuple[Columns, ...]] = {}

    def add(self, key: PartKey, payload: bytes) -> None:
        """Read a part.

        Raises:
            FormatError: it is malformed, or not the part that ``key`` says.
        """
        body = unpack_body(key.topic, payload)
        if body.index() != key.region:
            raise DamagedMapFileError(f"{key.topic}: of region {body.index()}, not {key.region}")
        if key.topic == REGION:
            self._head = read_head(body)
        elif key.topic == TRAINING:
            self._training = read_training_head(body)
        elif key.topic == EVIDENCE:
            self._cubes[key.cell] = read_evidence(body, key)
        elif key.topic in COLUMN_TOPICS:
            self._columns[key] = read_columns(body, key, self._settings)

    def region(self) -> Region:
        """The region; the caller has checked by the manifest that all parts are there.

        Raises:
            FormatError: parts do not fit together.
        """
        if self._head is None:
            raise DamagedMapFileError(f"the part {REGION} of region {self._index} is missing")
        tables = [columns for plane in range(len(AXES)) for columns in self._tables(plane)]
        places = [(plane, level) for plane in range(len(AXES)) for level in self._settings.levels]
        scales: list[Any] = self._head.scales or [None] * len(places)
        if len(scales) != len(places):
            raise DamagedMapFileError(f"{REGION}: {len(scales)} scales for {len(places)} tables")
        vertices = tuple(
            _vertex_table(place, columns, scale)
            for place, columns, scale in zip(places, tables, scales, strict=True)
        )
        return Region(
            index=self._index,
            frequencies=self._head.frequencies,
            mlp=self._head.mlp,
            tables=vertices,
            evidence=_joined_evidence([self._cubes[cell] for cell in sorted(self._cubes)]),
            training=self._training_state(),
        )

    def _of(self, topic: str, plane: int = 0) -> list[tuple[Columns, ...]]:
        """Parts of a topic in the order of their cells."""
        keys = sorted(k for k in self._columns if k.topic == topic and k.plane == plane)
        return [self._columns[key] for key in keys]

    def _tables(self, plane: int) -> list[Columns]:
        """Codes and features of a plane, level by level."""
        size = self._settings.feature_size
        empty = (np.zeros(0, np.int64), np.zeros((0, size), np.float16))
        return self._levels(VERTICES, plane, empty)

    def _levels(self, topic: str, plane: int, empty: Columns) -> list[Columns]:
        squares = self._of(topic, plane)
        return [
            _joined(topic, [square[h] for square in squares], empty)
            for h in range(self._settings.feature_levels)
        ]

    def _training_state(self) -> TrainingState | None:
        head = self._training
        if head is None:
            return None
        size = self._settings.feature_size
        rows = np.zeros((0, size), np.float32)
        moments = [
            columns
            for plane in range(len(AXES))
            for columns in self._levels(MOMENTS, plane, (rows, rows, np.zeros(0, np.int32)))
        ]
        empty = (np.zeros((0, 3), np.float32), np.zeros(0, np.float16))
        points, labels = _joined(SAMPLES, [part[0] for part in self._of(SAMPLES)], empty)
        if len(points) != head.samples:
            raise DamagedMapFileError(f"{SAMPLES}: {len(points)} samples, not {head.samples}")
        return TrainingState(
            table_means=tuple(columns[0] for columns in moments),
            table_variances=tuple(columns[1] for columns in moments),
            table_steps=tuple(columns[2] for columns in moments),
            mlp_means=head.mlp_means,
            mlp_variances=head.mlp_variances,
            mlp_steps=head.mlp_steps,
            sample_points=points,
            sample_labels=labels,
            budget_samples=head.budget_samples,
        )


def _vertex_table(place: tuple[int, int], columns: Columns, scale: float | None) -> VertexTable:
    codes, features = columns
    if scale is not None and not len(codes):
        features = features.astype(np.int16)  # no part tells of what dtype no rows are
    return VertexTable(*place, codes, features, scale)


def _joined(topic: str, portions: Iterable[Columns], empty: Columns) -> Columns:
    """The rows of all portions, column by column."""
    kept = list(portions)
    # The portion without rows gives dtypes where there is no other.
    kept = [portion for portion in kept if len(portion[0])] or kept[:1] or [empty]
    kinds = [(column.dtype, column.shape[1:]) for column in kept[0]]
    for portion in kept[1:]:
        if [(column.dtype, column.shape[1:]) for column in portion] != kinds:
            raise DamagedMapFileError(f"{topic}: parts of a table differ in dtype or shape")
    if len(kept) == 1:
        return kept[0]
    return tuple(np.concatenate(column) for column in zip(*kept, strict=True))


def _joined_evidence(portions: Sequence[Evidence]) -> Evidence:
    """The evidence of a region from that of its cubes, in their order.

    Where some of them tell no levels or times and others do, the former's are 0.
    """
    if len(portions) == 1:
        return portions[0]
    masks = np.zeros((0, BLOCK_BYTES), np.uint8)
    levels = [portion.levels for portion in portions]
    seen_s = [portion.seen_s for portion in portions]
    counts = [int(surface_counts(portion.surface).sum()) for portion in portions]
    return Evidence(
        np.concatenate([np.zeros(0, np.int64), *(portion.codes for portion in portions)]),
        np.concatenate([masks, *(portion.surface for portion in portions)]),
        np.concatenate([masks, *(portion.free for portion in portions)]),
        levels=_filled(levels, counts, np.uint8),
        seen_s=_filled(seen_s, [len(portion.codes) for portion in portions], np.int64),
    )


def _filled(
    columns: Sequence[NDArray[_Integer] | None], counts: Sequence[int], kind: type[_Integer]
) -> NDArray[_Integer] | None:
    """The columns in one, with zeros in place of those that are missing."""
    if all(column is None for column in columns):
        return None
    return np.concatenate(
        [
            np.zeros(count, kind) if column is None else column
            for column, count in zip(columns, counts, strict=True)
        ]
    )
