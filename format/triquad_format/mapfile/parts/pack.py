"""A map record as the parts of a map file, each a msgpack map.

``docs/map-file.md`` is the specification; :mod:`triquad_format.mapfile.parts.unpack` is the way
back.
"""

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from triquad_format.errors import FormatError
from triquad_format.mapfile.parts.body import pack_part
from triquad_format.mapfile.parts.columns import (
    shuffle,
    shuffle_codes,
    shuffle_counts,
    split_integers,
    split_levels,
)
from triquad_format.mapfile.parts.part import (
    EVIDENCE,
    MOMENTS,
    REGION,
    SAMPLES,
    TRAINING,
    VERTICES,
    Part,
    PartKey,
    cube_shift,
    square_shift,
)
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import (
    AXES,
    MapRecord,
    Region,
    RegionIndex,
    TrainingState,
    VertexTable,
    surface_counts,
)
from triquad_format.wire.array import pack_array

SAMPLES_PER_PART = 1 << 17

FEATURE_DTYPES = ("<f2", "<f4")
"""Precisions of features in a file."""


def pack_record(
    record: MapRecord, feature_dtype: str, previews: Mapping[RegionIndex, Part]
) -> Iterator[Part]:
    """The parts of all regions of a checked record, each region's preview after them.

    Raises:
        FormatError: features do not fit ``feature_dtype``, one of ``FEATURE_DTYPES``.
    """
    for region in record.regions:
        yield from pack_region(region, record.settings, feature_dtype)
        if region.index in previews:
            yield previews[region.index]


def pack_region(region: Region, settings: FieldSettings, feature_dtype: str) -> Iterator[Part]:
    """The parts of a checked region, in the order of the file.

    Args:
        region: as :func:`triquad_format.records.record_check.check_record` accepts it.
        settings: of its map.
        feature_dtype: one of ``FEATURE_DTYPES``, for features that are not integers.

    Raises:
        FormatError: features do not fit ``feature_dtype``; the text names the region.
    """
    yield _pack_head(region)
    for plane in range(len(AXES)):
        yield from _pack_vertices(region, plane, settings, feature_dtype=feature_dtype)
    yield from _pack_evidence(region)
    if region.training is not None:
        yield from _pack_training(region, region.training, settings)


def _pack_part(key: PartKey, fields: Mapping[str, object]) -> Part:
    """A part of a region, with what tells its place."""
    place: dict[str, object] = {"region": list(key.region)}
    if key.topic not in (REGION, TRAINING):
        place |= {"plane": key.plane, "cell": key.cell}
    return pack_part(key, {**place, **fields})


def _pack_head(region: Region) -> Part:
    scales = [table.scale for table in region.tables]
    body = {
        "frequencies": pack_array(region.frequencies),
        "weights": [pack_array(weight) for weight in region.mlp.weights],
        "biases": [pack_array(bias) for bias in region.mlp.biases],
        "scales": pack_array(np.array([s for s in scales if s is not None], np.float32)),
    }
    return _pack_part(PartKey(REGION, region.index), body)


def _pack_vertices(
    region: Region, plane: int, settings: FieldSettings, *, feature_dtype: str
) -> Iterator[Part]:
    tables = [table for table in region.tables if table.plane == plane]
    for cell, rows in _squares(tables, settings):
        levels = []
        for table, of_level in zip(tables, rows, strict=True):
            first_code = cell << square_shift(settings, table.level)
            codes = shuffle_codes(table.codes[of_level] - first_code)
            try:
                features = _pack_features(table, of_level, feature_dtype)
            except FormatError as error:
                raise FormatError(f"region {region.index}: {error}") from error
            levels.append({"codes": pack_array(codes), **features})
        yield _pack_part(
            PartKey(VERTICES, region.index, plane=plane, cell=cell), {"levels": levels}
        )


def _squares(
    tables: list[VertexTable], settings: FieldSettings
) -> Iterator[tuple[int, list[slice]]]:
    """The squares that hold vertices of a plane, with the rows of each table."""
    cells = [table.codes >> square_shift(settings, table.level) for table in tables]
    for cell in np.unique(np.concatenate(cells)).tolist():
        yield cell, [_rows_of(column, cell) for column in cells]


def _rows_of(cells: NDArray[np.int64], cell: int) -> slice:
    first, last = np.searchsorted(cells, [cell, cell + 1])
    return slice(int(first), int(last))


def _pack_features(table: VertexTable, rows: slice, dtype: str) -> dict[str, object]:
    features = table.features[rows]
    if table.scale is not None:
        return {"integers": pack_array(split_integers(features.astype(np.int16)))}
    with np.errstate(over="ignore"):
        features = features.astype(dtype)
    if not np.isfinite(features).all():
        raise FormatError(
            f"features of plane {table.plane}, level {table.level} reach "
            f"{np.abs(table.features).max()}, which {dtype} does not hold; use '<f4'",
        )
    return {"features": pack_array(shuffle(features))}


def _pack_evidence(region: Region) -> Iterator[Part]:
    evidence = region.evidence
    cells = evidence.codes >> cube_shift()
    first_voxel = np.concatenate([[0], np.cumsum(surface_counts(evidence.surface))])
    for cell in np.unique(cells).tolist():
        rows = _rows_of(cells, cell)
        surface = evidence.surface[rows]
        fields: dict[str, object] = {
            "codes": pack_array(shuffle_codes(evidence.codes[rows] - (cell << cube_shift()))),
            "surface": pack_array(surface),
            "free": pack_array(evidence.free[rows]),
        }
        if evidence.levels is not None:
            levels = evidence.levels[first_voxel[rows.start] : first_voxel[rows.stop]]
            fields["levels"] = pack_array(split_levels(levels))
        if evidence.seen_s is not None:
            fields |= _seen_fields(evidence.seen_s[rows][surface.any(axis=1)])
        yield _pack_part(PartKey(EVIDENCE, region.index, cell=cell), fields)


def _seen_fields(seen_s: NDArray[np.int64]) -> dict[str, object]:
    """Times of the blocks with surface, as seconds since shortly before the first of them."""
    known = seen_s[seen_s > 0]
    start = int(known.min()) - 1 if len(known) else 0
    since = np.maximum(seen_s - start, 0)
    return {"seen_from_s": start, "seen_s": pack_array(shuffle_counts(since))}


def _pack_training(
    region: Region, training: TrainingState, settings: FieldSettings
) -> Iterator[Part]:
    fields = {
        "mlp_means": [pack_array(mean) for mean in training.mlp_means],
        "mlp_variances": [pack_array(variance) for variance in training.mlp_variances],
        "mlp_steps": training.mlp_steps,
        "training_budget": training.budget_samples,
        "samples": len(training.sample_points),
    }
    yield _pack_part(PartKey(TRAINING, region.index), fields)
    yield from _pack_moments(region, training, settings)
    for number, first in enumerate(range(0, len(training.sample_points), SAMPLES_PER_PART)):
        rows = slice(first, first + SAMPLES_PER_PART)
        samples = {
            "points": pack_array(shuffle(training.sample_points[rows])),
            "labels": pack_array(shuffle(training.sample_labels[rows])),
        }
        yield _pack_part(PartKey(SAMPLES, region.index, cell=number), samples)


def _pack_moments(
    region: Region, training: TrainingState, settings: FieldSettings
) -> Iterator[Part]:
    for plane in range(len(AXES)):
        numbers = [i for i, table in enumerate(region.tables) if table.plane == plane]
        tables = [region.tables[i] for i in numbers]
        for cell, rows in _squares(tables, settings):
            levels = [
                {
                    "means": pack_array(shuffle(training.table_means[i][of_level])),
                    "variances": pack_array(shuffle(training.table_variances[i][of_level])),
                    "steps": pack_array(shuffle(training.table_steps[i][of_level])),
                }
                for i, of_level in zip(numbers, rows, strict=True)
            ]
            yield _pack_part(
                PartKey(MOMENTS, region.index, plane=plane, cell=cell), {"levels": levels}
            )
