"""A map of many regions, and the questions that they answer together."""

from collections.abc import Iterator, Sequence

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import leaf_coordinates

from triquad_map.composition.field_view import FieldView
from triquad_map.composition.region import MapRegion
from triquad_map.composition.region_lattice import Lattice
from triquad_map.composition.split import Split, in_one
from triquad_map.composition.unknown_space import UnknownSpace
from triquad_map.nearest import NearestSurface, NearestUnknown, no_surfels
from triquad_map.surface.confidence import faded

_LEAST_SEARCHES = 1024
"""Points for which it is worth while to start another thread that searches."""


class ComposedView(FieldView):
    """An immutable map: every answer comes from the same state. Safe to read from any thread."""

    def __init__(
        self,
        epoch: int,
        settings: FieldSettings,
        regions: Sequence[MapRegion],
        lattice: Lattice | None = None,
        split: Split = in_one,
    ) -> None:
        """``lattice`` finds owners and ``split`` shares work; they differ in speed alone."""
        super().__init__(settings, regions, lattice, split)
        self.epoch = epoch
        self.region_views = tuple(regions)
        self._unknown = UnknownSpace(settings, self.region_views)
        self._newest_s = max((region.evidence.newest_s for region in regions), default=0)

    @property
    def voxel_m(self) -> float:
        """Side of the voxels in which rays ended."""
        return self._settings.leaf_m

    def nearest_surface(self, points: Doubles, max_distance_m: float) -> NearestSurface:
        """The nearest seen surface to points [N, 3], searched for as far as ``max_distance_m``."""
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

    def nearest_unknown(self, points: Doubles, max_distance_m: float) -> NearestUnknown:
        """The nearest unknown space to points [N, 3], searched for as far as ``max_distance_m``."""
        nearest = NearestUnknown(np.full(len(points), max_distance_m), points.copy())

        def work(first: int, last: int) -> None:
            part = slice(first, last)
            mine = NearestUnknown(nearest.distance[part], nearest.point[part])
            self._unknown.improve(mine, points[part])

        self._split(len(points), work, _LEAST_SEARCHES)
        return nearest

    def _regions_near(self, points: Doubles, reach_m: float) -> Iterator[MapRegion]:
        """Regions that come within ``reach_m`` of the box around the points [N, 3]."""
        if not len(points):
            return
        low, high = points.min(axis=0) - reach_m, points.max(axis=0) + reach_m
        half = self._settings.region_side_m / 2
        for region in self.region_views:
            if (region.centre - half <= high).all() and (region.centre + half >= low).all():
                yield region

    def _improve(
        self, nearest: NearestSurface, points: Doubles, part: slice, region: MapRegion
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
