"""A map in compiled code: its regions, and the questions they answer together."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import RegionIndex, leaf_coordinates
from triquad_format.records.status import Status

from triquad_map.compiled.blended_field import BlendedField, FieldEngine, PlacedField
from triquad_map.compiled.evidence.evidence import Evidence
from triquad_map.compiled.evidence.unknown_space import PlacedEvidence, UnknownSpace
from triquad_map.compiled.region_lattice import Owned, RegionLattice
from triquad_map.compiled.surfels.surfel_map import SampleField, SurfelMap
from triquad_map.nearest import NearestSurface, NearestUnknown, no_surfels
from triquad_map.reference.evaluator import Answer
from triquad_map.surface.confidence import faded
from triquad_map.surface.surfels import FieldSample

Work = Callable[[int, int], None]

_LEAST_SEARCHES = 1024
"""Points for which it is worth while to start another thread that searches."""


class Split(Protocol):
    """Runs work over ``range(count)``, in parts at the same time where it is worth it."""

    def __call__(self, count: int, work: Work, least: int = ...) -> None:
        """``least`` is how many a part has at least, where the default is too many."""


def in_one(count: int, work: Work, least: int = 0) -> None:  # noqa: ARG001
    """A :class:`Split` for the caller's thread alone."""
    work(0, count)


class PlacedRegion(PlacedField, PlacedEvidence, Protocol):
    """One region of a map that does not change; surfels may be made when they are asked for."""

    @property
    def surfels(self) -> SurfelMap:
        """What stands for its surface. Not to be asked for within a :class:`Split`."""


@dataclass(frozen=True)
class RegionView:
    """A region of which all is there."""

    index: RegionIndex
    centre: NDArray[np.float64]  # [3] map frame
    engine: FieldEngine
    evidence: Evidence
    surfels: SurfelMap


def field_samples(engine: FieldEngine, settings: FieldSettings, split: Split) -> SampleField:
    """The field of a region in voxels, at its leaf coordinates."""
    middle = 1 << (settings.depth - 1)

    def sample(voxels: NDArray[np.float64]) -> FieldSample:
        local = ((voxels - middle) * settings.leaf_m).astype(np.float32)
        values = np.empty(len(local), np.float32)
        gradients = np.empty((len(local), 3), np.float32)

        def work(first: int, last: int) -> None:
            part = engine.evaluate(local[first:last], True)
            values[first:last] = part.sdf / settings.leaf_m
            gradients[first:last] = part.gradient

        split(len(local), work)
        return FieldSample(values, gradients)

    return sample


class CompiledView:
    """An immutable map: every answer comes from the same state. Safe to read from any thread."""

    def __init__(
        self,
        number: int,
        settings: FieldSettings,
        regions: Sequence[PlacedRegion],
        split: Split = in_one,
    ) -> None:
        self.number = number
        self.region_views = tuple(regions)
        self._settings = settings
        self._split = split
        self._field = BlendedField(settings, self.region_views)
        self._unknown = UnknownSpace(settings, self.region_views)
        self._lattice = RegionLattice(settings, [region.index for region in regions])
        self._newest_s = max((_newest_s(region.evidence) for region in regions), default=0)

    @property
    def voxel_m(self) -> float:
        """Side of the voxels in which rays ended."""
        return self._settings.leaf_m

    def query(self, points: NDArray[np.float64], gradient: bool = False) -> Answer:
        """Signed distance, status and, on request, gradient at points [N, 3] of the map frame."""
        count = len(points)
        sdf = np.empty(count, np.float32)
        status = np.empty(count, np.uint8)
        slopes = np.empty((count, 3), np.float32) if gradient else None

        def work(first: int, last: int) -> None:
            part = slice(first, last)
            owners = self._lattice.owners(points[part])
            groups = list(owners.groups())
            values = self._field.values(points[part], groups, owners.shared, gradient)
            sdf[part] = values.sdf
            if slopes is not None:
                slopes[part] = values.gradient
            status[part] = self._status(points[part], groups)

        self._split(count, work)
        return Answer(sdf, status, slopes)

    def distances(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        """Signed distances [N] alone at points [N, 3] of the map frame."""
        distances = np.empty(len(points), np.float32)

        def work(first: int, last: int) -> None:
            part = slice(first, last)
            owners = self._lattice.owners(points[part])
            groups = owners.groups()
            distances[part] = self._field.values(points[part], groups, owners.shared, False).sdf

        self._split(len(points), work)
        return distances

    def status(
        self,
        points: NDArray[np.float64],
        reach_m: float | None = None,
    ) -> NDArray[np.uint8]:
        """Status values [N] of points [N, 3]: what the evidence of each point's region says.

        ``SURFACE`` reaches ``reach_m`` beyond the voxels in which rays ended; half a voxel if
        not given.
        """
        reach = 0.5 if reach_m is None else reach_m / self._settings.leaf_m
        status = np.empty(len(points), np.uint8)

        def work(first: int, last: int) -> None:
            part = slice(first, last)
            groups = self._lattice.owners(points[part]).groups()
            status[part] = self._status(points[part], groups, reach)

        self._split(len(points), work)
        return status

    def nearest_surface(self, points: NDArray[np.float64], max_distance_m: float) -> NearestSurface:
        """The nearest seen surface to points [N, 3], looked for as far as ``max_distance_m``."""
        nearest = NearestSurface.none(len(points), max_distance_m)
        # Here, not in the threads of the split: to make surfels may take all of these.
        near = [
            region for region in self._regions_near(points, max_distance_m) if len(region.surfels)
        ]

        def work(first: int, last: int) -> None:
            for region in near:
                self._improve(nearest, points, slice(first, last), region)

        self._split(len(points), work, _LEAST_SEARCHES)
        return nearest

    def nearest_unknown(self, points: NDArray[np.float64], max_distance_m: float) -> NearestUnknown:
        """The nearest unknown space to points [N, 3], looked for as far as ``max_distance_m``."""
        nearest = NearestUnknown(np.full(len(points), max_distance_m), points.copy())

        def work(first: int, last: int) -> None:
            part = slice(first, last)
            mine = NearestUnknown(nearest.distance[part], nearest.point[part])
            self._unknown.improve(mine, points[part])

        self._split(len(points), work, _LEAST_SEARCHES)
        return nearest

    def _regions_near(self, points: NDArray[np.float64], reach_m: float) -> Iterator[PlacedRegion]:
        """Regions that come within ``reach_m`` of the box around the points [N, 3]."""
        if not len(points):
            return
        low, high = points.min(axis=0) - reach_m, points.max(axis=0) + reach_m
        half = self._settings.region_side_m / 2
        for region in self.region_views:
            if (region.centre - half <= high).all() and (region.centre + half >= low).all():
                yield region

    def _improve(
        self,
        nearest: NearestSurface,
        points: NDArray[np.float64],
        part: slice,
        region: PlacedRegion,
    ) -> None:
        """Take what is nearer in a region."""
        leaf_m = self._settings.leaf_m
        offsets = points[part] - region.centre
        beyond = np.maximum(np.abs(offsets) - self._settings.region_side_m / 2, 0.0)
        near = np.flatnonzero((beyond**2).sum(axis=1) < nearest.distance[part] ** 2)
        if not len(near):
            return
        found = no_surfels(nearest.distance[part][near] / leaf_m)
        surfels = region.surfels
        surfels.find_nearest(leaf_coordinates(self._settings, offsets[near]), found)
        hits = np.flatnonzero(found.rows >= 0)
        found = found.at(hits)
        age_s = (self._newest_s - surfels.seen_s[found.rows]).astype(np.float64)
        confidence = np.multiply(surfels.confidence[found.rows], faded(age_s))
        corner = region.centre - self._settings.region_side_m / 2
        nearest.take(near[hits] + (part.start or 0), found, corner, leaf_m, confidence)

    def _status(
        self, points: NDArray[np.float64], groups: Iterable[Owned], reach: float = 0.5
    ) -> NDArray[np.uint8]:
        status = np.full(len(points), Status.UNKNOWN, np.uint8)
        for owned in groups:
            region = self.region_views[owned.region]
            voxels = leaf_coordinates(self._settings, points[owned.points] - region.centre)
            status[owned.points] = region.evidence.status(voxels, reach)
        return status


def _newest_s(evidence: Evidence) -> int:
    """When a ray last ended anywhere, seconds since 1970; 0: never, or not known."""
    return int(evidence.seen_s().max(initial=0))
