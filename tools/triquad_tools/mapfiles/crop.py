"""A map cut down to what lies in a box, or freed of training state."""

import dataclasses

import numpy as np
from numpy.typing import ArrayLike
from triquad_format.records import morton
from triquad_format.records.arrays import Bytes
from triquad_format.records.field_settings import BLOCK_VOXELS, FieldSettings
from triquad_format.records.leaf_box import LeafBox, check_box, leaf_box, whole_region
from triquad_format.records.region import AXES, Evidence, MapRecord, VertexTable, masked

_REACH_VOXELS = 0.5  # a point is near a surface where one was seen this far away


def crop_record(record: MapRecord, minimum: ArrayLike, maximum: ArrayLike) -> MapRecord:
    """Return what a map needs to answer inside a box, to the last bit as before.

    Regions whose cube meets the box stay, with the vertices whose hat functions reach into it and
    the evidence in it, without the state that training needs.

    Args:
        record: the map.
        minimum: ``[3]`` corner of the box, metres, map frame.
        maximum: ``[3]`` opposite corner.

    Raises:
        FormatError: the corners are not finite or not in order.
    """
    low, high = np.subtract(check_box(minimum, maximum), record.origin)
    regions = []
    for region in record.regions:
        box = leaf_box(record.settings, region.index, low=low, high=high)
        if box.meets(whole_region(record.settings)):
            tables = tuple(_crop_table(record.settings, table, box) for table in region.tables)
            evidence = masked(region.evidence, status_voxels(region.evidence, box))
            cropped = dataclasses.replace(region, tables=tables, evidence=evidence, training=None)
            regions.append(cropped)
    return dataclasses.replace(record, regions=tuple(regions))


def without_training(record: MapRecord) -> MapRecord:
    """Return the map without the state that training needs: it answers as before."""
    regions = tuple(dataclasses.replace(region, training=None) for region in record.regions)
    return dataclasses.replace(record, regions=regions)


def _crop_table(settings: FieldSettings, table: VertexTable, box: LeafBox) -> VertexTable:
    """Return the vertices that have a hat function that is not zero all over the box."""
    axes = list(AXES[table.plane])
    vertices = morton.decode(table.codes, 2)
    scale = 1 << (settings.depth - table.level)
    below = (vertices - 1) * scale <= box.high[axes]
    above = (vertices + 1) * scale >= box.low[axes]
    kept = (below & above).all(axis=1)
    return dataclasses.replace(table, codes=table.codes[kept], features=table.features[kept])


def status_voxels(evidence: Evidence, box: LeafBox) -> Bytes:
    """Return bits [B, BLOCK_BYTES] of the voxels that decide the status in a box."""
    first = morton.decode(evidence.codes, 3) * BLOCK_VOXELS
    voxels = first[:, :, None] + np.arange(BLOCK_VOXELS)  # [B, 3, 8]
    low, high = box.low - _REACH_VOXELS, box.high + _REACH_VOXELS
    inside = (voxels + 1 >= low[:, None]) & (voxels <= high[:, None])
    columns = inside[:, 0, :, None] & inside[:, 1, None, :]  # [B, x, y]
    heights = np.packbits(inside[:, 2], axis=1, bitorder="little")  # [B, 1]
    mask = np.where(columns.reshape(len(columns), BLOCK_VOXELS**2), heights, 0)
    return mask.astype(np.uint8)
