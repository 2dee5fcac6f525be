"""The rays that a map has kept, by the scans that they come from."""

from dataclasses import dataclass

import numpy as np
from triquad_format.records import morton
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS, FieldSettings
from triquad_format.records.region import MapRecord, Region
from triquad_format.records.replay_rays import ReplayRays

_TOGETHER_M = 1e-3
"""Rays whose origins differ by less come from one scan: each region tells of its own."""

_NEVER_S = np.iinfo(np.int64).max


@dataclass(frozen=True)
class KeptScan:
    """The rays of a scan that a map has kept, metres, from the map's origin."""

    origin: Doubles  # [3]
    ends: Doubles  # [N, 3]
    stamp_s: int
    """When it was taken, at the latest, seconds since 1970: no block in which its rays end was seen
    earlier for the last time."""


def kept_scans(record: MapRecord) -> list[KeptScan]:
    """Return the scans of which a map has kept rays, by their stamps."""
    settings, regions = record.settings, record.regions
    starts = np.concatenate([_starts(region, settings) for region in regions])
    ends = kept_ends(record)
    stamps = np.concatenate([_stamps(region, settings) for region in regions])
    cells = np.round(starts / _TOGETHER_M).astype(np.int64)
    _, first, scan_of = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(scan_of.ravel(), kind="stable")
    bounds = np.cumsum(np.bincount(scan_of.ravel()))[:-1]
    parts = zip(first, np.split(ends[order], bounds), np.split(stamps[order], bounds), strict=True)
    scans = [
        KeptScan(starts[row], some, 0 if (stamp_s := int(seen.min())) == _NEVER_S else stamp_s)
        for row, some, seen in parts
    ]
    return sorted(scans, key=lambda scan: scan.stamp_s)


def kept_ends(record: MapRecord) -> Doubles:
    """Return where the rays end that a map has kept, [N, 3] metres, from the map's origin."""
    settings = record.settings
    return np.concatenate([_ends(region, settings) for region in record.regions])


def _starts(region: Region, settings: FieldSettings) -> Doubles:
    rays = _rays(region)
    return settings.region_centre(region.index) + rays.origins[rays.origin_of].astype(np.float64)


def _ends(region: Region, settings: FieldSettings) -> Doubles:
    return settings.region_centre(region.index) + _rays(region).ends_m(settings)


def _stamps(region: Region, settings: FieldSettings) -> Longs:
    """Return when the blocks were last seen in which rays [N] end; never outside of the region."""
    evidence, side_m = region.evidence, BLOCK_VOXELS * settings.leaf_m
    offsets = _ends(region, settings) - settings.region_corner(region.index)
    cells = np.floor(offsets / side_m).astype(np.int64)
    inside = ((cells >= 0) & (cells < (1 << settings.depth) // BLOCK_VOXELS)).all(axis=1)
    stamps = np.full(len(cells), _NEVER_S)
    codes = morton.encode(cells[inside])
    if len(evidence.codes):
        rows = np.searchsorted(evidence.codes, codes).clip(max=len(evidence.codes) - 1)
        known = (evidence.codes[rows] == codes) & (evidence.seen_s[rows] > 0)
        stamps[inside] = np.where(known, evidence.seen_s[rows], _NEVER_S)
    return stamps


def _rays(region: Region) -> ReplayRays:
    assert region.training is not None, "it was checked"
    return region.training.rays
