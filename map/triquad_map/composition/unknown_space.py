"""How far it is to space of which nothing is known."""

import itertools
from collections.abc import Iterable

import numpy as np
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import RegionIndex, leaf_coordinates, owned_blocks

from triquad_map.composition.region import MapRegion
from triquad_map.nearest import NearestUnknown

_FARTHEST_CELL = 1 << 20


class UnknownSpace:
    """The unknown space of all regions, and all that lies in none."""

    def __init__(self, settings: FieldSettings, regions: Iterable[MapRegion]) -> None:
        self._settings = settings
        self._regions = {region.index: region for region in regions}

    def improve(self, found: NearestUnknown, points: Doubles) -> None:
        """Improve ``found`` where unknown space lies nearer to ``points`` [N, 3]."""
        homes, owners = np.unique(self._cells(points), axis=0, return_inverse=True)
        owners = owners.reshape(-1)
        known = np.array([tuple(home) in self._regions for home in homes.tolist()], np.bool_)
        # Most points that are far from the map need nothing more, however many cells they lie in.
        nowhere = np.flatnonzero(~known[owners])
        found.distance[nowhere] = 0.0
        found.point[nowhere] = points[nowhere]
        for number in np.flatnonzero(known):
            rows = np.flatnonzero(owners == number)
            near = NearestUnknown(found.distance[rows], found.point[rows])
            x, y, z = homes[number].tolist()
            self._improve_near(near, points[rows], (x, y, z))
            found.distance[rows], found.point[rows] = near.distance, near.point

    def _improve_near(self, found: NearestUnknown, points: Doubles, home: RegionIndex) -> None:
        """As :meth:`improve`, of points in the cell of one region."""
        # Mostly that is all: what it finds is nearer than the other cells.
        self._search_region(found, points, self._regions[home])
        for cell in self._cells_around(points, float(found.distance.max())):
            region = self._regions.get(cell)
            if region is None:
                self._search_empty_cell(found, points, cell)
            elif cell != home:
                self._search_region(found, points, region)

    def _cells(self, points: Doubles) -> Longs:
        """Cells [N, 3] of the region lattice that hold the points; far ones at its ends."""
        cells = np.floor(points / self._settings.region_pitch_m + 0.5)
        return np.clip(cells, -_FARTHEST_CELL, _FARTHEST_CELL).astype(np.int64)

    def _cells_around(self, points: Doubles, reach_m: float) -> list[RegionIndex]:
        """Cells that come within ``reach_m`` of the box around the points."""
        low = self._cells(points.min(axis=0) - reach_m).tolist()
        high = self._cells(points.max(axis=0) + reach_m).tolist()
        x, y, z = (range(first, last + 1) for first, last in zip(low, high, strict=True))
        return list(itertools.product(x, y, z))

    def _search_empty_cell(self, found: NearestUnknown, points: Doubles, cell: RegionIndex) -> None:
        """Nothing is known of a cell without a region."""
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
        voxels = leaf_coordinates(self._settings, points - region.centre)
        distances = found.distance / leaf_m
        before = distances.copy()
        nearest = np.empty((len(points), 3))
        region.evidence.find_unknown(voxels, owned_blocks(self._settings), distances, nearest)
        nearer = distances < before
        found.distance[nearer] = distances[nearer] * leaf_m
        corner = region.centre - self._settings.region_side_m / 2
        found.point[nearer] = corner + nearest[nearer] * leaf_m
