"""Several regions are one map: what lies nearest is found whichever region it is in."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from support.maps.map_records import evidence_of, random_record, with_support
from triquad_format.records import morton
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.region import BLOCK_BYTES, MapRecord
from triquad_map.composition.composed_view import RecordedView
from triquad_map.surfels.surfel_search import no_surfels

TWO = ((0, 0, 0), (1, 0, 0))
APART = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (-4, 2, 1))
"""Neighbours by a face and by an edge, and one far away."""


class SlowSpace:
    """What rays have shown of a map, voxel by voxel of the map frame."""

    def __init__(self, record: MapRecord) -> None:
        self.settings = record.settings
        self.blocks = {
            (region.index, *block): region.evidence.surface[row] | region.evidence.free[row]
            for region in record.regions
            for row, block in enumerate(morton.decode(region.evidence.codes, 3).tolist())
        }

    def is_seen(self, voxel: np.ndarray) -> bool:
        """Whether a ray ended in a voxel or crossed it, by the region that owns it."""
        middle = (voxel + 0.5) * self.settings.leaf_m
        x, y, z = (math.floor(c / self.settings.region_pitch_m + 0.5) for c in middle)
        corner = self.settings.region_corner((x, y, z)) / self.settings.leaf_m
        inner = voxel - np.round(corner).astype(int)
        masks = self.blocks.get(((x, y, z), *(inner // 8).tolist()))
        a, b, c = (inner % 8).tolist()
        return masks is not None and bool(masks[a * 8 + b] >> c & 1)

    def nearest_unknown(self, point: np.ndarray, reach_m: float) -> float:
        at, reach = point / self.settings.leaf_m, reach_m / self.settings.leaf_m
        sides = [range(math.floor(c - reach), math.floor(c + reach) + 1) for c in at]
        nearest = reach
        for voxel in map(np.array, itertools.product(*sides)):
            gap = float(np.linalg.norm(at - np.clip(at, voxel, voxel + 1)))
            if gap < nearest and not self.is_seen(voxel):
                nearest = gap
        return nearest * self.settings.leaf_m


def widely_seen(record: MapRecord) -> MapRecord:
    """The record with evidence everywhere; of every seventh block half the voxels are unknown."""
    side = (1 << record.settings.depth) // 8
    codes = np.arange(side**3)
    masks = np.full((len(codes), BLOCK_BYTES), 255, np.uint8)
    masks[::7] = np.random.default_rng(0).integers(0, 256, masks[::7].shape)
    evidence = evidence_of(codes, np.zeros_like(masks), masks)
    regions = tuple(dataclasses.replace(region, evidence=evidence) for region in record.regions)
    return dataclasses.replace(record, regions=regions)


def across_the_border(record: MapRecord, count: int, spread_m: float) -> np.ndarray:
    """Points around the middle of the face between the regions (0, 0, 0) and (1, 0, 0)."""
    face = np.array([record.settings.region_pitch_m / 2, 0.0, 0.0])
    return face + np.random.default_rng(1).uniform(-spread_m, spread_m, (count, 3))


@pytest.mark.parametrize("spread_m", [1.0, 5.0])
def test_the_nearest_unknown_space_may_lie_in_another_region(spread_m: float) -> None:
    record = widely_seen(random_record(3, indices=TWO, training=False))
    points = across_the_border(record, 40, spread_m)
    found = RecordedView(record).nearest_unknown(points, 1.2)
    slow = SlowSpace(record)
    expected = [slow.nearest_unknown(point, 1.2) for point in points]
    np.testing.assert_allclose(found.distance, expected, atol=1e-9)
    assert len(set(np.round(expected, 3))) > 10, "all kinds of distances are met"
    there = found.distance < 1.2
    gaps = np.linalg.norm(points - found.point, axis=1)
    np.testing.assert_allclose(gaps[there], found.distance[there], atol=1e-9)


@pytest.mark.parametrize("indices", [TWO, APART])
def test_the_nearest_surface_is_that_of_the_region_where_it_is_nearest(
    indices: tuple[RegionIndex, ...],
) -> None:
    record = with_support(random_record(4, indices=indices, points=60, training=False))
    leaf_m = record.settings.leaf_m
    points = np.random.default_rng(5).uniform(-20, 30, (200, 3))
    found = RecordedView(record).nearest_surface(points, 9.0)
    best = np.full(len(points), 9.0)
    for region in record.regions:
        alone = RecordedView(dataclasses.replace(record, regions=(region,)))
        corner = record.settings.region_corner(region.index)
        nearest = no_surfels(np.full(len(points), 1e4))
        everywhere = np.full(3, -np.inf), np.full(3, np.inf)
        for surfels in alone.region_views[0].surfels_between(*everywhere):
            surfels.find_nearest((points - corner) / leaf_m, nearest)
        best = np.minimum(best, nearest.distances * leaf_m)
    np.testing.assert_allclose(found.distance, best, atol=1e-9)
    np.testing.assert_array_equal(found.found, best < 9.0)
    gaps = np.linalg.norm(points - found.point, axis=1)
    np.testing.assert_allclose(gaps[found.found], best[found.found], atol=1e-9)


def test_confidence_fades_with_the_age_since_anything_was_seen_anywhere() -> None:
    record = with_support(random_record(4, indices=TWO, points=60, training=False))
    old, new = record.regions
    seen_s = [
        np.where(region.evidence.surface.any(axis=1), when, 0)
        for region, when in ((old, 1_000_000), (new, 1_000_000 + 86_400))
    ]
    regions = tuple(
        dataclasses.replace(region, evidence=dataclasses.replace(region.evidence, seen_s=times))
        for region, times in zip((old, new), seen_s, strict=True)
    )
    far_left = np.random.default_rng(6).uniform(-8, 0, (50, 3))
    both = RecordedView(dataclasses.replace(record, regions=regions))
    alone = RecordedView(dataclasses.replace(record, regions=regions[:1]))
    aged, fresh = (view.nearest_surface(far_left, 3.0) for view in (both, alone))
    same = (aged.distance == fresh.distance) & aged.found
    assert same.sum() > 10
    np.testing.assert_allclose(aged.confidence[same], fresh.confidence[same] / 2, rtol=1e-5)
