"""The space that rays of a map have shown: voxels and columns of its evidence, in metres."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records import morton
from triquad_format.records.field_settings import BLOCK_VOXELS, FieldSettings
from triquad_format.records.region import Evidence, MapRecord, Region, masked, seen_voxels


@dataclass(frozen=True)
class Columns:
    """Upright columns of voxels, each within one block of evidence."""

    middles: NDArray[np.float64]  # [N, 2] metres, map frame
    tops: NDArray[np.float64]  # [N] height of the middle of the highest voxel, metres


def owned_evidence(settings: FieldSettings, region: Region) -> Evidence:
    """The evidence that answers of the region hang on; the rest lies in its neighbours' space."""
    blocks, mine = morton.decode(region.evidence.codes, 3), settings.owned_blocks
    owned = ((blocks >= mine.start) & (blocks < mine.stop)).all(axis=1, keepdims=True)
    return masked(region.evidence, np.where(owned, np.uint8(0xFF), np.uint8(0)))


def evidence_box(settings: FieldSettings, region: Region) -> NDArray[np.float64] | None:
    """Corners [2, 3] of the box around a region's evidence, to whole blocks, metres, map frame.

    ``None`` where there is no evidence.
    """
    if not len(region.evidence.codes):
        return None
    blocks = morton.decode(region.evidence.codes, 3)
    ends = np.stack([blocks.min(axis=0), blocks.max(axis=0) + 1])
    return settings.region_corner(region.index) + ends * (settings.leaf_m * BLOCK_VOXELS)


def evidence_bounds(record: MapRecord) -> NDArray[np.float64] | None:
    """The same box around all that rays have shown of a map."""
    found = [evidence_box(record.settings, region) for region in record.regions]
    boxes = [box for box in found if box is not None]
    if not boxes:
        return None
    return np.array([np.min(boxes, axis=(0, 1)), np.max(boxes, axis=(0, 1))])


def surface_voxels(record: MapRecord) -> NDArray[np.float64]:
    """Middles ``[N, 3]`` of the voxels in which rays ended, metres, map frame."""
    parts = [np.empty((0, 3))]
    for region in record.regions:
        evidence = owned_evidence(record.settings, region)
        voxels = seen_voxels(evidence, evidence.surface)
        parts.append(_metres(record.settings, region, voxels))
    return np.concatenate(parts)


def seen_columns(record: MapRecord, surface_only: bool = False) -> Columns:
    """The columns in which rays ended or, unless ``surface_only``, through which they passed."""
    parts = [np.empty((0, 3))]
    for region in record.regions:
        evidence = owned_evidence(record.settings, region)
        # A byte holds one column.
        octets = evidence.surface if surface_only else evidence.surface | evidence.free
        rows, numbers = np.nonzero(octets)
        x, y = np.divmod(numbers, BLOCK_VOXELS)
        top = np.log2(octets[rows, numbers], dtype=np.float32).astype(np.int64)
        voxels = morton.decode(evidence.codes, 3)[rows] * BLOCK_VOXELS + np.stack([x, y, top], 1)
        parts.append(_metres(record.settings, region, voxels))
    middles = np.concatenate(parts)
    return Columns(middles[:, :2], middles[:, 2])


def _metres(
    settings: FieldSettings, region: Region, voxels: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Middles ``[N, 3]`` of voxels ``[N, 3]`` of a region."""
    corner = settings.region_corner(region.index)
    return corner + (voxels + 0.5) * settings.leaf_m
