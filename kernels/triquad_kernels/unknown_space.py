"""How far it is to space of which nothing is known."""

from collections.abc import Iterable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from triquad_format.field_settings import FieldSettings
from triquad_format.region import BLOCK_VOXELS, RegionIndex, leaf_coordinates

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

    def lower(
        self, points: NDArray[np.float64], distances: NDArray[np.float64], reach_m: float
    ) -> None:
        """Lower ``distances`` [N] to those from ``points`` [N, 3] to unknown space.

        It is looked for as far as ``reach_m``.
        """
        for cell in self._cells_around(points, reach_m):
            region = self._regions.get(cell)
            if region is None:
                self._lower_to_cell(distances, points, cell)
            else:
                self._lower_in_region(distances, points, region)

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

    def _lower_to_cell(
        self, distances: NDArray[np.float64], points: NDArray[np.float64], cell: RegionIndex
    ) -> None:
        """Nothing is known of a cell without a region."""
        pitch = self._settings.region_pitch_m
        gaps = np.maximum(np.abs(points - np.asarray(cell) * pitch) - pitch / 2, 0.0)
        np.minimum(distances, np.sqrt((gaps**2).sum(axis=1)), out=distances)

    def _lower_in_region(
        self, distances: NDArray[np.float64], points: NDArray[np.float64], region: PlacedEvidence
    ) -> None:
        """Look at what a region owns of the space around."""
        blocks = (1 << self._settings.depth) // BLOCK_VOXELS
        margin = round(self._settings.overlap_m / 2 / self._settings.leaf_m) // BLOCK_VOXELS
        voxels = leaf_coordinates(self._settings, points - region.centre)
        scaled = distances / self._settings.leaf_m
        region.evidence.to_unknown(voxels, scaled, (margin, blocks - margin))
        np.minimum(distances, scaled * self._settings.leaf_m, out=distances)
