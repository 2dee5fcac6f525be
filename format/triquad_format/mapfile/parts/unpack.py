"""The parts of a map file back into a map record; every field is checked as it is read."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triquad_format.errors import DamagedMapFileError
from triquad_format.mapfile.manifest import Entry, Manifest
from triquad_format.mapfile.map_facts import check_map_part
from triquad_format.mapfile.parts.cell import cube_shift, square_shift
from triquad_format.mapfile.parts.evidence import joined, read_evidence
from triquad_format.mapfile.parts.pack import SAMPLES_PER_PART
from triquad_format.mapfile.parts.part import (
    EVIDENCE,
    MAP,
    MOMENTS,
    REGION,
    REGION_TOPICS,
    SAMPLES,
    TRAINING,
    VERTICES,
    PartKey,
)
from triquad_format.mapfile.parts.part_body import PartBody
from triquad_format.mapfile.parts.shuffle import unshuffle
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import (
    AXES,
    MLP_LAYERS,
    Evidence,
    MapRecord,
    Mlp,
    Region,
    RegionIndex,
    TrainingState,
    VertexTable,
)

Columns = tuple[NDArray[Any], ...]
"""Columns of equal length: some rows of a table."""


@dataclass(frozen=True)
class _Head:
    """What a region has one of."""

    frequencies: NDArray[np.float32]
    mlp: Mlp
    scales: list[float]  # of each table, or none at all


@dataclass(frozen=True)
class _TrainingHead:
    """What a region's training state has one of."""

    mlp_means: tuple[NDArray[np.float32], ...]
    mlp_variances: tuple[NDArray[np.float32], ...]
    mlp_steps: int
    budget_samples: int
    samples: int


class RegionParts:
    """The parts of one region, gathered in any order."""

    def __init__(self, index: RegionIndex, settings: FieldSettings) -> None:
        self._index = index
        self._settings = settings
        self._head: _Head | None = None
        self._training: _TrainingHead | None = None
        self._cubes: dict[int, Evidence] = {}
        self._columns: dict[PartKey, tuple[Columns, ...]] = {}

    def add(self, key: PartKey, payload: bytes) -> None:
        """Read a part.

        Raises:
            FormatError: it is malformed, or not the part that ``key`` says.
        """
        body = PartBody(key.topic, payload)
        if body.index() != key.region:
            raise DamagedMapFileError(f"{key.topic}: of region {body.index()}, not {key.region}")
        if key.topic == REGION:
            self._head = _read_head(body)
        elif key.topic == TRAINING:
            self._training = _read_training_head(body)
        elif key.topic == EVIDENCE:
            _expect_place(body, key)
            self._cubes[key.cell] = _read_evidence(body, key)
        elif key.topic in _READERS:
            _expect_place(body, key)
            self._columns[key] = _READERS[key.topic](body, key, self._settings)

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
            evidence=joined([self._cubes[cell] for cell in sorted(self._cubes)]),
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


def assemble(manifest: Manifest, payload_of: Callable[[Entry], bytes]) -> MapRecord:
    """The record of the parts that a manifest lists.

    Args:
        manifest: the list; regions come in the order of their parts ``/triquad/region``.
        payload_of: gives the checked payload of a part; it is asked once for each.

    Raises:
        FormatError: a part is missing, malformed or does not fit the others.
    """
    settings = manifest.facts.settings
    by_region: dict[RegionIndex, list[Entry]] = {}
    for entry in manifest.entries:
        if entry.key.topic == REGION:
            by_region[entry.key.region] = []
    for entry in manifest.entries:
        if entry.key.topic == MAP:
            check_map_part(payload_of(entry), manifest.facts)
        elif entry.key.topic in REGION_TOPICS:
            by_region[entry.key.region].append(entry)
    regions = []
    for index, entries in by_region.items():
        parts = RegionParts(index, settings)
        for entry in entries:
            parts.add(entry.key, payload_of(entry))
        regions.append(parts.region())
    return MapRecord(manifest.facts.name, manifest.facts.epoch, settings, tuple(regions))


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


def _expect_place(body: PartBody, key: PartKey) -> None:
    body.expect("plane", key.plane)
    body.expect("cell", key.cell)


def _read_head(body: PartBody) -> _Head:
    mlp = Mlp(body.arrays("weights", MLP_LAYERS), body.arrays("biases", MLP_LAYERS))
    scales = body.array("scales", "<f4", None).tolist()
    return _Head(body.array("frequencies", "<f4", None), mlp, scales)


def _read_training_head(body: PartBody) -> _TrainingHead:
    return _TrainingHead(
        body.arrays("mlp_means", 2 * MLP_LAYERS),
        body.arrays("mlp_variances", 2 * MLP_LAYERS),
        body.count("mlp_steps"),
        body.count("visits_owed"),
        body.count("samples"),
    )


# Sizes are checked before anything is decoded, which takes more memory than a part has bytes.


def _read_vertices(body: PartBody, key: PartKey, settings: FieldSettings) -> tuple[Columns, ...]:
    size = settings.feature_size
    levels: list[Columns] = []
    for level, rows in zip(
        settings.levels, body.maps("levels", settings.feature_levels), strict=True
    ):
        shift = square_shift(settings, level)
        codes = _global(rows.codes("codes", 1 << shift), key, shift)
        if rows.has("integers"):
            levels.append((codes, rows.integers("integers", len(codes), size)))
        else:
            levels.append((codes, rows.floats("features", len(codes), size)))
    return tuple(levels)


def _read_evidence(body: PartBody, key: PartKey) -> Evidence:
    codes = _global(body.codes("codes", 1 << cube_shift()), key, cube_shift())
    return read_evidence(body, codes)


def _read_moments(body: PartBody, _key: PartKey, settings: FieldSettings) -> tuple[Columns, ...]:
    size = settings.feature_size
    levels: list[Columns] = []
    for level, rows in zip(
        settings.levels, body.maps("levels", settings.feature_levels), strict=True
    ):
        steps = rows.array("steps", "|u1", 4, None)
        count = steps.shape[1]
        rows.limit("steps", count, 1 << square_shift(settings, level))
        means, variances = (rows.floats(name, count, size) for name in ("means", "variances"))
        levels.append((means, variances, unshuffle(steps, "<i4")))
    return tuple(levels)


def _read_samples(body: PartBody, _key: PartKey, _settings: FieldSettings) -> tuple[Columns, ...]:
    points = body.array("points", "|u1", 4, None, 3)
    count = points.shape[1]
    body.limit("points", count, SAMPLES_PER_PART)
    return ((unshuffle(points, "<f4"), body.floats("labels", count)),)


_READERS: Mapping[str, Callable[[PartBody, PartKey, FieldSettings], tuple[Columns, ...]]] = {
    VERTICES: _read_vertices,
    MOMENTS: _read_moments,
    SAMPLES: _read_samples,
}


def _global(local: NDArray[np.int64], key: PartKey, shift: int) -> NDArray[np.int64]:
    """Codes [V] from those within a square or cube."""
    if len(local) and not 0 <= local.max() < 1 << shift:
        raise DamagedMapFileError(f"{key.topic}: a code lies outside of cell {key.cell}")
    if key.cell >= 1 << 60 - shift:
        raise DamagedMapFileError(f"{key.topic}: cell {key.cell} is out of range")
    return local + (key.cell << shift)
