"""A map cut down to a box, or freed of what only training needs."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from triquad_format import morton
from triquad_format.errors import FormatError
from triquad_format.field_settings import FieldSettings
from triquad_format.region import (
    AXES,
    BLOCK_VOXELS,
    Evidence,
    MapRecord,
    Region,
    RegionIndex,
    TrainingState,
    VertexTable,
    region_centre,
)

SLACK_LEAVES = 1 / 16
"""Kept around the box: points are rounded to float32, at depth 15 by up to 1/128 of a leaf."""

_STATUS_VOXELS = 0.5
"""A point is near a surface where one was seen this far away."""


@dataclass(frozen=True)
class LeafBox:
    """The box in the leaf coordinates of one region."""

    low: NDArray[np.float64]  # [3]
    high: NDArray[np.float64]  # [3]

    def meets_region(self, settings: FieldSettings) -> bool:
        """Whether any of the region's cube lies in the box."""
        return bool((self.low <= 1 << settings.depth).all() and (self.high >= 0).all())


def crop_record(record: MapRecord, minimum: ArrayLike, maximum: ArrayLike) -> MapRecord:
    """What a map needs to answer inside a box, to the last bit as before.

    Regions whose cube meets the box stay, with the vertices whose hat functions reach into it,
    the evidence in it, and the replay samples in it with their share of the visits owed.

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
        if box.meets_region(record.settings):
            regions.append(_crop_region(record.settings, region, box))
    return dataclasses.replace(record, regions=tuple(regions))


def check_box(
    minimum: ArrayLike, maximum: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The corners [3] of a box; a :class:`FormatError` where they are not finite or in order."""
    low, high = np.asarray(minimum, np.float64), np.asarray(maximum, np.float64)
    if not (np.isfinite([low, high]).all() and (low < high).all()):
        raise FormatError(f"a box from {low.tolist()} to {high.tolist()} holds nothing")
    return low, high


def without_training(record: MapRecord) -> MapRecord:
    """The map without the state that training needs: it answers as before."""
    regions = tuple(dataclasses.replace(region, training=None) for region in record.regions)
    return dataclasses.replace(record, regions=regions)


def leaf_box(
    settings: FieldSettings,
    index: RegionIndex,
    low: NDArray[np.float64],
    high: NDArray[np.float64],
) -> LeafBox:
    """The box between two corners [3] of the map frame, grown by what rounding may need."""
    centre = region_centre(settings, index)
    half = 1 << (settings.depth - 1)
    return LeafBox(
        (low - centre) / settings.leaf_m + half - SLACK_LEAVES,
        (high - centre) / settings.leaf_m + half + SLACK_LEAVES,
    )


def _crop_region(settings: FieldSettings, region: Region, box: LeafBox) -> Region:
    kept = [_reaching(settings, table, box) for table in region.tables]
    tables = tuple(
        dataclasses.replace(table, codes=table.codes[rows], features=table.features[rows])
        for table, rows in zip(region.tables, kept, strict=True)
    )
    training = region.training
    if training is not None:
        training = _crop_training(settings, training, kept, box)
    evidence = _crop_evidence(region.evidence, box)
    return dataclasses.replace(region, tables=tables, evidence=evidence, training=training)


def _reaching(settings: FieldSettings, table: VertexTable, box: LeafBox) -> NDArray[np.intp]:
    """Rows of the vertices that have a hat function that is not zero all over the box."""
    axes = list(AXES[table.plane])
    cells = morton.decode(table.codes, 2)
    scale = 1 << (settings.depth - table.level)
    below = (cells - 1) * scale <= box.high[axes]
    above = (cells + 1) * scale >= box.low[axes]
    return np.flatnonzero((below & above).all(axis=1))


def voxel_mask(
    codes: NDArray[np.int64], low: NDArray[np.float64], high: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Bits [B, BLOCK_BYTES] of the voxels of blocks that meet a box.

    Args:
        codes: ``[B]`` of the blocks.
        low: ``[3]`` corner of the box, leaf coordinates of the region.
        high: ``[3]`` opposite corner.
    """
    first = morton.decode(codes, 3) * BLOCK_VOXELS
    voxels = first[:, :, None] + np.arange(BLOCK_VOXELS)  # [B, 3, 8]
    inside = (voxels + 1 >= low[:, None]) & (voxels <= high[:, None])
    columns = inside[:, 0, :, None] & inside[:, 1, None, :]  # [B, x, y]
    heights = np.packbits(inside[:, 2], axis=1, bitorder="little")  # [B, 1]
    mask = np.where(columns.reshape(len(columns), BLOCK_VOXELS**2), heights, 0)
    return mask.astype(np.uint8)


def masked(evidence: Evidence, mask: NDArray[np.uint8]) -> Evidence:
    """The evidence of the voxels whose bit is set in ``mask`` [B, BLOCK_BYTES]."""
    surface, free = evidence.surface & mask, evidence.free & mask
    rows = np.flatnonzero((surface | free).any(axis=1))
    return Evidence(evidence.codes[rows], surface[rows], free[rows])


def _crop_evidence(evidence: Evidence, box: LeafBox) -> Evidence:
    """Evidence without the voxels that no point of the box asks for."""
    low, high = box.low - _STATUS_VOXELS, box.high + _STATUS_VOXELS
    return masked(evidence, voxel_mask(evidence.codes, low, high))


def _crop_training(
    settings: FieldSettings,
    training: TrainingState,
    kept: list[NDArray[np.intp]],
    box: LeafBox,
) -> TrainingState:
    leaves = training.sample_points / settings.leaf_m + (1 << (settings.depth - 1))
    inside = np.flatnonzero(((leaves >= box.low) & (leaves <= box.high)).all(axis=1))
    owed = training.visits_owed * len(inside)  # rounded up below, so that none is forgotten
    return dataclasses.replace(
        training,
        table_means=_rows(training.table_means, kept),
        table_variances=_rows(training.table_variances, kept),
        table_steps=tuple(
            steps[rows] for steps, rows in zip(training.table_steps, kept, strict=True)
        ),
        sample_points=training.sample_points[inside],
        sample_labels=training.sample_labels[inside],
        visits_owed=-(-owed // max(len(leaves), 1)),
    )


def _rows(
    columns: tuple[NDArray[np.floating], ...], kept: list[NDArray[np.intp]]
) -> tuple[NDArray[np.floating], ...]:
    return tuple(column[rows] for column, rows in zip(columns, kept, strict=True))
