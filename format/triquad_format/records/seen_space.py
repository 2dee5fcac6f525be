"""The space that rays of a map have shown: its evidence in metres of the map frame."""

import numpy as np

from triquad_format.records import morton
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import Evidence, MapRecord, Region, masked, seen_voxels


def owned_evidence(settings: FieldSettings, region: Region) -> Evidence:
    """Return the evidence that answers of the region depend on, without its neighbours' space."""
    blocks, mine = morton.decode(region.evidence.codes, 3), settings.owned_blocks
    owned = ((blocks >= mine.start) & (blocks < mine.stop)).all(axis=1, keepdims=True)
    return masked(region.evidence, np.where(owned, np.uint8(0xFF), np.uint8(0)))


def surface_voxels(record: MapRecord) -> Doubles:
    """Return middles [N, 3] of the voxels in which rays ended, metres from the map's origin."""
    settings, parts = record.settings, [np.empty((0, 3))]
    for region in record.regions:
        evidence = owned_evidence(settings, region)
        voxels = seen_voxels(evidence, evidence.surface)
        parts.append(settings.region_corner(region.index) + (voxels + 0.5) * settings.leaf_m)
    return np.concatenate(parts)
