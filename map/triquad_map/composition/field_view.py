"""The field and the status of a map of many regions."""

from collections.abc import Iterable, Sequence

import numpy as np
from triquad_format.records.arrays import Bytes, Doubles, Floats
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import leaf_coordinates
from triquad_format.records.status import Status

from triquad_map.composition.blended_field import BlendedField
from triquad_map.composition.region import FieldRegion
from triquad_map.composition.region_lattice import Lattice, Owned, RegionLattice
from triquad_map.composition.split import Split, in_one
from triquad_map.view import FieldAnswer

_REACH_VOXELS = 0.5
"""How far a surface is felt beyond the voxels in which rays ended."""


class FieldView:
    """Field and status of an immutable map, for any thread.

    Each point has one status, that of the region that owns it; the field is blended where regions
    overlap.
    """

    def __init__(
        self,
        settings: FieldSettings,
        regions: Sequence[FieldRegion],
        lattice: Lattice | None = None,
        split: Split = in_one,
    ) -> None:
        """``lattice`` finds owners and ``split`` shares work; they differ in speed alone."""
        self._settings = settings
        self._field_regions = tuple(regions)
        self._split = split
        self._field = BlendedField(settings, self._field_regions)
        self._lattice = lattice or RegionLattice(settings, [region.index for region in regions])

    def query(self, points: Doubles, gradient: bool = False) -> FieldAnswer:
        """Signed distance, status and, on request, gradient at points [N, 3] of the map frame."""
        count = len(points)
        sdf = np.empty(count, np.float32)
        status = np.empty(count, np.uint8)
        slopes = np.empty((count, 3), np.float32) if gradient else None

        def work(first: int, last: int) -> None:
            part = slice(first, last)
            owners = self._lattice.owners(points[part])
            values = self._field.values(points[part], owners, gradient)
            sdf[part] = values.sdf
            if slopes is not None:
                slopes[part] = values.gradient
            status[part] = self._status(points[part], owners.groups, _REACH_VOXELS)

        self._split(count, work)
        return FieldAnswer(sdf, status, slopes)

    def distances(self, points: Doubles) -> Floats:
        """Signed distances [N] alone at points [N, 3] of the map frame."""
        distances = np.empty(len(points), np.float32)

        def work(first: int, last: int) -> None:
            part = slice(first, last)
            owners = self._lattice.owners(points[part])
            distances[part] = self._field.values(points[part], owners, False).sdf

        self._split(len(points), work)
        return distances

    def status(self, points: Doubles, reach_m: float | None = None) -> Bytes:
        """Status values [N] of points [N, 3]: what the evidence of each point's region says.

        ``SURFACE`` reaches ``reach_m`` beyond the voxels in which rays ended; half a voxel if
        not given.
        """
        reach = _REACH_VOXELS if reach_m is None else reach_m / self._settings.leaf_m
        status = np.empty(len(points), np.uint8)

        def work(first: int, last: int) -> None:
            part = slice(first, last)
            groups = self._lattice.owners(points[part]).groups
            status[part] = self._status(points[part], groups, reach)

        self._split(len(points), work)
        return status

    def _status(self, points: Doubles, groups: Iterable[Owned], reach: float) -> Bytes:
        status = np.full(len(points), Status.UNKNOWN, np.uint8)
        for owned in groups:
            region = self._field_regions[owned.region]
            voxels = leaf_coordinates(self._settings, points[owned.points] - region.centre)
            status[owned.points] = region.evidence.status(voxels, reach)
        return status
