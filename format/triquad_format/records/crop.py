"""A map cut down to a box, or freed of what only training needs."""

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from triquad_format.records import morton
from triquad_format.records.evidence_voxels import masked, status_voxels
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.leaf_box import LeafBox, check_box, leaf_box, whole_region
from triquad_format.records.region import (
    AXES,
    MapRecord,
    Region,
    TrainingState,
    VertexTable,
    leaf_coordinates,
)


def crop_record(record: MapRecord, minimum: ArrayLike, maximum: ArrayLike) -> MapRecord:
    """What a map needs to answer inside a box, to the last bit as before.

    Regions whose cube meets the box stay, with the vertices whose hat functions reach into it,
    the evidence in it, and the replay samples in it with their share of the training budget.

    Args:
        record: the map.
        minimum: ``[3]`` corner of the box, metres, map frame.
        maximum: ``[3]`` opposite corner.

    Raises:
        FormatError: the corners are not finite or not in order.
    """
    low, high = check_box(minimum, maximum)
    regions = []
    for region in record.regions:
        box = leaf_box(record.settings, region.index, low, high)
        if box.meets(whole_region(record.settings)):
            regions.append(_crop_region(record.settings, region, box))
    return dataclasses.replace(record, regions=tuple(regions))


def without_training(record: MapRecord) -> MapRecord:
    """The map without the state that training needs: it answers as before."""
    regions = tuple(dataclasses.replace(region, training=None) for region in record.regions)
    return dataclasses.replace(record, regions=regions)


def _crop_region(settings: FieldSettings, region: Region, box: LeafBox) -> Region:
    kept = [_reaching(settings, table, box) for table in region.tables]
    tables = tuple(
        dataclasses.replace(table, codes=table.codes[rows], features=table.features[rows])
        for table, rows in zip(region.tables, kept, strict=True)
    )
    training = region.training
    if training is not None:
        training = _crop_training(settings, training, kept, box)
    evidence = masked(region.evidence, status_voxels(region.evidence, box))
    return dataclasses.replace(region, tables=tables, evidence=evidence, training=training)


def _reaching(settings: FieldSettings, table: VertexTable, box: LeafBox) -> NDArray[np.intp]:
    """Rows of the vertices that have a hat function that is not zero all over the box."""
    axes = list(AXES[table.plane])
    vertices = morton.decode(table.codes, 2)
    scale = 1 << (settings.depth - table.level)
    below = (vertices - 1) * scale <= box.high[axes]
    above = (vertices + 1) * scale >= box.low[axes]
    return np.flatnonzero((below & above).all(axis=1))


def _crop_training(
    settings: FieldSettings,
    training: TrainingState,
    kept: list[NDArray[np.intp]],
    box: LeafBox,
) -> TrainingState:
    leaves = leaf_coordinates(settings, training.sample_points)
    inside = np.flatnonzero(((leaves >= box.low) & (leaves <= box.high)).all(axis=1))
    owed = training.budget_samples * len(inside)  # rounded up below, so that none is forgotten
    return dataclasses.replace(
        training,
        table_means=_rows(training.table_means, kept),
        table_variances=_rows(training.table_variances, kept),
        table_steps=tuple(
            steps[rows] for steps, rows in zip(training.table_steps, kept, strict=True)
        ),
        sample_points=training.sample_points[inside],
        sample_labels=training.sample_labels[inside],
        budget_samples=-(-owed // max(len(leaves), 1)),
    )


def _rows(
    columns: tuple[NDArray[np.floating], ...], kept: list[NDArray[np.intp]]
) -> tuple[NDArray[np.floating], ...]:
    return tuple(column[rows] for column, rows in zip(columns, kept, strict=True))
