"""A region as a file has it."""

import threading
from collections.abc import Sequence

import numpy as np
from triquad_format.records import morton
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.leaf_box import leaf_box
from triquad_format.records.region import MapRecord, Region

from triquad_map.compiled.team import Split
from triquad_map.evidence.evidence import FrozenEvidence
from triquad_map.field.frozen_field import field_samples, recorded_field
from triquad_map.surfels.surfel_map import SurfelMap, first_surfels


class RecordedRegion:
    """A region of a record, whose surfels are fitted where they are first asked for."""

    def __init__(
        self, record: MapRecord, region: Region, split: Split, cube_voxels: int | None = None
    ) -> None:
        """Take a region of a record; ``split`` shares the work of fitting surfels.

        Those of cubes with sides of ``cube_voxels``, a multiple of a block's, are fitted together,
        and are found apart: where the nearest of two cubes are as near, directions are those of
        one. ``None``: all are.
        """
        self._settings = settings = record.settings
        self.index = region.index
        self.centre = settings.region_centre(region.index)
        self.field = recorded_field(settings, region)
        self.evidence = FrozenEvidence.from_record(1 << settings.depth, region.evidence)
        self._samples = field_samples(self.field, settings, split)
        self._epoch = record.epoch
        self._fitting = threading.Lock()
        self._cube_voxels = cube_voxels or 1 << settings.depth
        self._cubes, self._cube_of_block = self._cubes_with_surface()
        self._surfels: dict[int, SurfelMap] = {}  # by the number of their cube

    @property
    def newest_s(self) -> int:
        """When a ray last ended anywhere in it, seconds since 1970; 0: never, or not known."""
        return self.evidence.newest_s

    def surfels_between(self, low: Doubles, high: Doubles) -> Sequence[SurfelMap]:
        """Return the surfels that may lie between two corners [3], map frame, and some around.

        The first who asks for some waits until they are fitted.
        """
        box = leaf_box(self._settings, self.index, low, high)
        corners = self._cubes * self._cube_voxels
        # A surfel may lie in the voxel next to its own.
        near = (corners - 1 <= box.high) & (corners + self._cube_voxels + 1 >= box.low)
        with self._fitting:
            return [self._surfels_in(int(cube)) for cube in np.flatnonzero(near.all(axis=1))]

    def _cubes_with_surface(self) -> tuple[Longs, Longs]:
        """Return the cubes [C, 3] with surface, and the number of each block's [B]; -1: none."""
        cells, touched = self.evidence.cells, self.evidence.surface.any(axis=1)
        of_blocks = np.full(len(cells), -1, np.int64)
        codes = morton.encode(cells[touched] // (self._cube_voxels // BLOCK_VOXELS))
        cubes, of_blocks[touched] = np.unique(codes, return_inverse=True)
        return morton.decode(cubes, 3), of_blocks

    def _surfels_in(self, cube: int) -> SurfelMap:
        if cube not in self._surfels:
            part = self.evidence.part(np.flatnonzero(self._cube_of_block == cube))
            self._surfels[cube] = first_surfels(
                part, self._samples, self._epoch, around=self.evidence
            )
        return self._surfels[cube]
