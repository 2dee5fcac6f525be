"""How far it is to space of which nothing is known."""

from collections.abc import Iterable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from triquad_format.field_settings import FieldSettings
from triquad_format.region import RegionIndex, leaf_coordinates, owned_blocks
from triquad_query.nearest import NearestUnknown

from triquad_kernels.evidence import Evidence


class PlacedEvidence(Protocol):
    """The evidence of a region and where it is."""

    @property
    def index(self) -> RegionIndex:
        """Which region."""

    @property
    def centre(self) -> NDArray[np.float64]:
        """[3] metres, map frame."""

    @property
    def evidence(self) -> Evidence:
        """What rays have shown of it."""


class UnknownSpace:
    """The unknown space of all regions, and all that lies in none."""

    def __init__(self, settings: FieldSettings, regions: Iterable[PlacedEvidence]) -> None:
        self._settings = settings
        self._regions = {region.index: region for region in regions}

    def improve(self, found: NearestUnknown, points: NDArray[np.float64]) -> None:
        """Note in ``found`` what unknown space lies nearer to ``points`` [N, 3]."""
        for cell in self._cells_around(points, float(found.distance.max(initial=0.0))):
            region = self._regions.get(cell)
            if region is None:
                self._look_in_cell(found, points, cell)
            else:
                self._look_in_region(found, points, region)

    def _cells_around(self, points: NDArray[np.float64], reach_m: float) -> list[RegionIndex]:
        """Cells of the region lattice that come within ``reach_m`` of any of the points."""
        pitch = self._settings.region_pitch_m
        low = np.floor((points - reach_m) / pitch + 0.5).astype(np.int64)
        high = np.floor((points + reach_m) / pitch + 0.5).astype(np.int64)
        cells: set[RegionIndex] = set()
        for pair in np.unique(np.concatenate([low, high], axis=1), axis=0).tolist():
            spans = [range(pair[axis], pair[axis + 3] + 1) for axis in range(3)]
            cells |= {(x, y, z) for x in spans[0] for y in spans[1] for z in spans[2]}
        return sorted(cells)

    def _look_in_cell(
        self, found: NearestUnknown, points: NDArray[np.float64], cell: RegionIndex
    ) -> None:
        """Nothing is known of a cell without a region."""
        pitch = self._settings.region_pitch_m
        middle = np.asarray(cell) * pitch
        nearest = np.clip(points, middle - pitch / 2, middle + pitch / 2)
        distance = np.linalg.norm(points - nearest, axis=1)
        nearer = distance < found.distance
        found.distance[nearer] = distance[nearer]
        found.point[nearer] = nearest[nearer]

    def _look_in_region(
        self, found: NearestUnknown, points: NDArray[np.float64], region: PlacedEvidence
    ) -> None:
        """Look at what a region owns of the space around."""
        leaf_m = self._settings.leaf_m
        mine = owned_blocks(self._settings)
        voxels = leaf_coordinates(self._settings, points - region.centre)
        distances = found.distance / leaf_m
        before = distances.copy()
        nearest = np.empty((len(points), 3))
        region.evidence.find_unknown(voxels, (mine.start, mine.stop), distances, nearest)
        nearer = distances < before
        found.distance[nearer] = distances[nearer] * leaf_m
        corner = region.centre - self._settings.region_side_m / 2
        found.point[nearer] = corner + nearest[nearer] * leaf_m
