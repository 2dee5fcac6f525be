"""A map as a file holds it, answered with numpy alone: slow, and what compiled code must equal."""

import threading
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records import morton
from triquad_format.records.evidence_voxels import seen_voxels, surface_counts
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import MapRecord, Region, region_corner

from triquad_map.nearest import NearestSurface, NearestUnknown
from triquad_map.reference.evaluator import CHUNK_POINTS, Answer, MapEvaluator, RegionField
from triquad_map.reference.seen_space import SeenSpace
from triquad_map.reference.surfel_cloud import SurfelCloud
from triquad_map.reference.voxel_blocks import VoxelBlocks
from triquad_map.surface.confidence import faded, support_confidence
from triquad_map.surface.surfels import Field, FieldSample, fit_surfels


class RecordedMap:
    """A :class:`~triquad_map.view.MapView` of a record. For several threads."""

    def __init__(self, record: MapRecord) -> None:
        self.number = record.epoch
        self._settings = record.settings
        self._evaluator = MapEvaluator(record)
        self._seen = SeenSpace(record)
        newest_s = max((_newest_s(region) for region in record.regions), default=0)
        self._surfaces = [
            _RegionSurface(record.settings, region, newest_s) for region in record.regions
        ]

    @property
    def voxel_m(self) -> float:
        """Side of the voxels in which rays ended."""
        return self._settings.leaf_m

    def query(self, points: NDArray[np.float64], gradient: bool = False) -> Answer:
        """The trained field and the status at points [N, 3]."""
        return self._evaluator.query(points, gradient)

    def status(self, points: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Status values [N] of points [N, 3]."""
        return self._evaluator.status(points)

    def nearest_surface(self, points: NDArray[np.float64], max_distance_m: float) -> NearestSurface:
        """The nearest seen surface to points [N, 3], looked for as far as ``max_distance_m``."""
        nearest = NearestSurface.none(len(points), max_distance_m)
        for surface in self._surfaces:
            surface.improve(nearest, points)
        return nearest

    def nearest_unknown(self, points: NDArray[np.float64], max_distance_m: float) -> NearestUnknown:
        """The nearest unknown space to points [N, 3], looked for as far as ``max_distance_m``."""
        return self._seen.nearest_unknown(points, max_distance_m)


class _RegionSurface:
    """The surface seen in one region; surfels are fitted when they are first needed."""

    def __init__(self, settings: FieldSettings, region: Region, newest_s: int) -> None:
        """``newest_s`` is when a ray last ended anywhere."""
        self._settings = settings
        self._region = region
        self._newest_s = newest_s
        self._corner = region_corner(settings, region.index)
        self._fitting = threading.Lock()
        self._fitted: _FittedSurface | None = None

    def improve(self, nearest: NearestSurface, points: NDArray[np.float64]) -> None:
        """Take what lies nearer in this region."""
        leaf_m, side_m = self._settings.leaf_m, self._settings.region_side_m
        gaps = np.maximum(np.abs(points - self._corner - side_m / 2) - side_m / 2, 0.0)
        near = np.flatnonzero(np.linalg.norm(gaps, axis=1) < nearest.distance)
        if not len(near):
            return
        surfels = self._surfels()
        voxels = (points[near] - self._corner) / leaf_m
        found = surfels.cloud.nearest(voxels, nearest.distance[near] / leaf_m)
        hits = np.flatnonzero(found.rows >= 0)
        found = found.at(hits)
        confidence = surfels.confidence[found.rows]
        nearest.take(near[hits], found, self._corner, leaf_m, confidence)

    def _surfels(self) -> "_FittedSurface":
        with self._fitting:
            if self._fitted is None:
                self._fitted = _fit(self._settings, self._region, self._newest_s)
            return self._fitted


@dataclass(frozen=True)
class _FittedSurface:
    """The surfels of a region."""

    cloud: SurfelCloud
    confidence: NDArray[np.float32]  # [S] of each surfel


def _newest_s(region: Region) -> int:
    """When a ray last ended in a region, seconds since 1970; 0: never, or not known."""
    seen_s = region.evidence.seen_s
    return 0 if seen_s is None else int(seen_s.max(initial=0))


def _fit(settings: FieldSettings, region: Region, newest_s: int) -> _FittedSurface:
    evidence = region.evidence
    voxels = seen_voxels(evidence, evidence.surface)
    ended = VoxelBlocks(morton.decode(evidence.codes, 3), evidence.surface)
    surfels = fit_surfels(voxels, _field_in_voxels(settings, region), ended.holds)
    levels = np.zeros(len(voxels), np.uint8) if evidence.levels is None else evidence.levels
    confidence = support_confidence(levels, surfels.kinds)
    if evidence.seen_s is not None:
        seen_s = np.repeat(evidence.seen_s, surface_counts(evidence.surface))
        confidence *= faded((newest_s - seen_s).astype(np.float64))
    return _FittedSurface(SurfelCloud(voxels, surfels), confidence)


def _field_in_voxels(settings: FieldSettings, region: Region) -> Field:
    """The field of a region in voxels, at its leaf coordinates."""
    field = RegionField(settings, region)
    middle = 1 << (settings.depth - 1)

    def sample(voxels: NDArray[np.float64]) -> FieldSample:
        local = ((voxels - middle) * settings.leaf_m).astype(np.float32)
        values = np.empty(len(local), np.float32)
        gradients = np.empty((len(local), 3), np.float32)
        for first in range(0, len(local), CHUNK_POINTS):
            part = slice(first, first + CHUNK_POINTS)
            value, gradients[part] = field.evaluate(local[part], True)
            values[part] = value / settings.leaf_m
        return FieldSample(values, gradients)

    return sample
