"""A map record as the parts of a map file, each a msgpack map.

``docs/map-file.md`` is the specification; :mod:`triquad_format.mapfile.parts.unpack` is the way
back.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from triquad_format.errors import FormatError
from triquad_format.mapfile.map_facts import MapFacts, pack_facts
from triquad_format.mapfile.parts.cell import square_shift
from triquad_format.mapfile.parts.evidence import evidence_bodies
from triquad_format.mapfile.parts.part import (
    EVIDENCE,
    MAP,
    MOMENTS,
    REGION,
    SAMPLES,
    TRAINING,
    VERTICES,
    Part,
    PartKey,
)
from triquad_format.mapfile.parts.part_body import pack_part
from triquad_format.mapfile.parts.shuffle import shuffle, shuffle_codes, split_integers
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import (
    AXES,
    Region,
    TrainingState,
    VertexTable,
)
from triquad_format.wire.array import pack_array

SAMPLES_PER_PART = 1 << 17

FEATURE_DTYPES = ("<f2", "<f4")


def pack_map(facts: MapFacts) -> Part:
    """The first part of a file."""
    return pack_part(PartKey(MAP), pack_facts(facts))


def pack_region(region: Region, settings: FieldSettings, feature_dtype: str) -> Iterator[Part]:
    """The parts of a checked region, in the order of the file.

    Raises:
        FormatError: features do not fit ``feature_dtype``.
    """
    yield _pack_head(region)
    for plane in range(len(AXES)):
        tables = [table for table in region.tables if table.plane == plane]
        for cell, rows in _squares(tables, settings):
            levels = [
                _pack_rows(table, of_level, cell, settings, feature_dtype)
                for table, of_level in zip(tables, rows, strict=True)
            ]
            yield pack_part(
                PartKey(VERTICES, region.index, plane, cell),
                {**_place(region, plane, cell), "levels": levels},
            )
    yield from _pack_evidence(region)
    if region.training is not None:
        yield from _pack_training(region, region.training, settings)


def _place(region: Region, plane: int, cell: int) -> dict[str, object]:
    return {"region": list(region.index), "plane": plane, "cell": cell}


def _pack_head(region: Region) -> Part:
    scales = [table.scale for table in region.tables]
    body = {
        "region": list(region.index),
        "frequencies": pack_array(region.frequencies),
        "weights": [pack_array(weight) for weight in region.mlp.weights],
        "biases": [pack_array(bias) for bias in region.mlp.biases],
        "scales": pack_array(np.array([s for s in scales if s is not None], np.float32)),
    }
    return pack_part(PartKey(REGION, region.index), body)


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


def _pack_rows(
    table: VertexTable, rows: slice, cell: int, settings: FieldSettings, dtype: str
) -> dict[str, object]:
    codes = shuffle_codes(table.codes[rows] - (cell << square_shift(settings, table.level)))
    features = table.features[rows]
    if table.scale is not None:
        integers = split_integers(features.astype(np.int16))
        return {"codes": pack_array(codes), "integers": pack_array(integers)}
    with np.errstate(over="ignore"):
        features = features.astype(dtype)
    if not np.isfinite(features).all():
        raise FormatError(
            f"features of plane {table.plane}, level {table.level} reach "
            f"{np.abs(table.features).max()}, which {dtype} does not hold; use '<f4'",
        )
    return {"codes": pack_array(codes), "features": pack_array(shuffle(features))}


def _pack_evidence(region: Region) -> Iterator[Part]:
    for cell, fields in evidence_bodies(region.evidence):
        body = {**_place(region, 0, cell), **fields}
        yield pack_part(PartKey(EVIDENCE, region.index, 0, cell), body)


def _pack_training(
    region: Region, training: TrainingState, settings: FieldSettings
) -> Iterator[Part]:
    body = {
        "region": list(region.index),
        "mlp_means": [pack_array(mean) for mean in training.mlp_means],
        "mlp_variances": [pack_array(variance) for variance in training.mlp_variances],
        "mlp_steps": training.mlp_steps,
        "visits_owed": training.budget_samples,
        "samples": len(training.sample_points),
    }
    yield pack_part(PartKey(TRAINING, region.index), body)
    yield from _pack_moments(region, training, settings)
    for number, first in enumerate(range(0, len(training.sample_points), SAMPLES_PER_PART)):
        rows = slice(first, first + SAMPLES_PER_PART)
        samples = {
            **_place(region, 0, number),
            "points": pack_array(shuffle(training.sample_points[rows])),
            "labels": pack_array(shuffle(training.sample_labels[rows])),
        }
        yield pack_part(PartKey(SAMPLES, region.index, 0, number), samples)


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
            yield pack_part(
                PartKey(MOMENTS, region.index, plane, cell),
                {**_place(region, plane, cell), "levels": levels},
            )
