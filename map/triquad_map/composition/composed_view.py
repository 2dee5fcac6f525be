"""A map of many regions, and the questions that they answer together; one as a file has it."""

import itertools
import logging
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.field_settings import FieldSettings, RegionIndex
from triquad_format.records.region import MapRecord

from triquad_map.compiled.kernel import is_first_use
from triquad_map.compiled.team import Split, Team, in_one
from triquad_map.composition.field_view import FieldView, MapRegion, Owners
from triquad_map.composition.recorded_region import RecordedRegion
from triquad_map.surfels.surfel_map import RegionFrame, SurfelMap
from triquad_map.view import NearestSurface, NearestUnknown

_log = logging.getLogger(__name__)

_FARTHEST_CELL = 1 << 20
_LEAST_SEARCHES = 128
"""Points for which it is worth while to start another thread that searches."""


class ComposedView(FieldView):
    """An immutable map: every answer comes from the same state. Safe to read from any thread."""

    def __init__(
        self,
        epoch: int,
        settings: FieldSettings,
        regions: Sequence[MapRegion],
        split: Split = in_one,
    ) -> None:
        """Compose regions; ``split`` shares the work of a question among threads."""
        super().__init__(settings, regions, split)
        self.epoch = epoch
        self._newest_s = max((region.newest_s for region in regions), default=0)

    @property
    def voxel_m(self) -> float:
        """Side of the voxels in which rays ended."""
        return self._settings.leaf_m

    def nearest_surface(self, points: Doubles, max_distance_m: float) -> NearestSurface:
        """Return the nearest seen surface to points [N, 3], as far as ``max_distance_m``."""
        count = len(points)
        nearest = NearestSurface(
            found=np.zeros(count, np.bool_),
            distance=np.full(count, max_distance_m),
            point=np.zeros((count, 3)),
            gradient=np.zeros((count, 3)),
            confidence=np.zeros(count, np.float32),
            learnt=np.ones(count, np.bool_),
            normal=np.zeros((count, 3), np.float32),
        )
        if not count:
            return nearest
        low, high = _box_around(points, max_distance_m)
        # One after the other: each may have to be read, and all together may be too much.
        for region in self._regions_between(low, high):
            # Here, not in the threads of the split: to make surfels may take all of these.
            near, frame = region.surfels_between(low, high), self._frame(region)
            self._split(count, partial(_improve, nearest, points, near, frame), _LEAST_SEARCHES)
        return nearest

    def nearest_unknown(self, points: Doubles, max_distance_m: float) -> NearestUnknown:
        """Return the nearest unknown space to points [N, 3], as far as ``max_distance_m``.

        What lies in no region is unknown, too.
        """
        nearest = NearestUnknown(np.zeros(len(points)), points.copy())

        def work(part: slice, owners: Owners) -> None:
            for owned in owners.groups:
                mine = points[part][owned.points]
                near = NearestUnknown(np.full(len(mine), max_distance_m), mine.copy())
                self._improve_in_cell(near, mine, owned.region.index)
                nearest.distance[part][owned.points] = near.distance
                nearest.point[part][owned.points] = near.point

        self._for_owners(points, work, _LEAST_SEARCHES)
        return nearest

    def _regions_between(self, low: Doubles, high: Doubles) -> Iterator[MapRegion]:
        """Yield the regions that meet the box between two corners [3]."""
        half = self._settings.region_side_m / 2
        for region in self.region_views:
            if (region.centre - half <= high).all() and (region.centre + half >= low).all():
                yield region

    def _frame(self, region: MapRegion) -> RegionFrame:
        """Return where the region's leaf coordinates lie, for its surfels."""
        x, y, z = self._settings.region_corner(region.index).tolist()
        return RegionFrame((x, y, z), self._settings.leaf_m, self._newest_s)

    def _improve_in_cell(self, found: NearestUnknown, points: Doubles, home: RegionIndex) -> None:
        """Improve ``found`` by unknown space nearer to points [N, 3], which a region owns."""
        # Mostly that is all: what it finds is nearer than the other cells.
        self._search_region(found, points, self._regions_at[home])
        for cell in self._cells_around(points, float(found.distance.max())):
            region = self._regions_at.get(cell)
            if region is None:
                self._search_empty_cell(found, points, cell)
            elif cell != home:
                self._search_region(found, points, region)

    def _cells_of(self, points: Doubles) -> Longs:
        """Return cells [N, 3] of the region lattice that contain points; far ones at its ends."""
        cells = np.floor(points / self._settings.region_pitch_m + 0.5)
        return np.clip(cells, -_FARTHEST_CELL, _FARTHEST_CELL).astype(np.int64)

    def _cells_around(self, points: Doubles, reach_m: float) -> list[RegionIndex]:
        """Return cells that come within ``reach_m`` of the box around the points."""
        low, high = (self._cells_of(corner).tolist() for corner in _box_around(points, reach_m))
        x, y, z = (range(first, last + 1) for first, last in zip(low, high, strict=True))
        return list(itertools.product(x, y, z))

    def _search_empty_cell(self, found: NearestUnknown, points: Doubles, cell: RegionIndex) -> None:
        """Improve ``found`` by a cell without a region, of which nothing is known."""
        pitch = self._settings.region_pitch_m
        middle = np.asarray(cell) * pitch
        nearest = np.clip(points, middle - pitch / 2, middle + pitch / 2)
        distance = np.linalg.norm(points - nearest, axis=1)
        nearer = distance < found.distance
        found.distance[nearer] = distance[nearer]
        found.point[nearer] = nearest[nearer]

    def _search_region(self, found: NearestUnknown, points: Doubles, region: MapRegion) -> None:
        """Search what a region owns of the space around."""
        leaf_m = self._settings.leaf_m
        voxels = self._voxels(region, points)
        distances = found.distance / leaf_m
        before = distances.copy()
        nearest = np.empty((len(points), 3))
        region.evidence.find_unknown(
            voxels, self._settings.owned_blocks, distances=distances, nearest=nearest
        )
        nearer = distances < before
        found.distance[nearer] = distances[nearer] * leaf_m
        corner = region.centre - self._settings.region_side_m / 2
        found.point[nearer] = corner + nearest[nearer] * leaf_m


class RecordedView(ComposedView):
    """The map in a record. Questions are split over all cores, by threads of its own."""

    def __init__(self, record: MapRecord) -> None:
        if is_first_use():
            _log.warning(
                "compiling, at the first questions of each kind; once per machine and release"
            )
        self._team = Team("triquad-questions")
        regions = [RecordedRegion(record, region, self._team.split) for region in record.regions]
        super().__init__(record.epoch, record.settings, regions, split=self._team.split)

    def close(self) -> None:
        """End the threads; later questions are answered on the caller's alone."""
        self._team.close()


def _improve(
    nearest: NearestSurface,
    points: Doubles,
    near: Sequence[SurfelMap],
    frame: RegionFrame,
    first: int,
    last: int,
) -> None:
    """Improve ``nearest`` where surfels lie nearer to some of the points [N, 3]."""
    mine = NearestSurface._make(array[first:last] for array in nearest)
    for surfels in near:
        surfels.improve(mine, points[first:last], frame)


def _box_around(points: Doubles, reach_m: float) -> tuple[Doubles, Doubles]:
    """Return the least and largest corner [3] of a box around points [N, 3], with N at least 1.

    It reaches ``reach_m`` beyond them on each side.
    """
    by_axis = np.ascontiguousarray(points.T)  # ten times as fast as along the other axis
    return by_axis.min(axis=1) - reach_m, by_axis.max(axis=1) + reach_m
