"""A published, immutable state of the map, and the questions it answers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.field_settings import FieldSettings
from triquad_format.region import BLOCK_VOXELS, MapRecord, RegionIndex, region_centre
from triquad_kernels.compiled_view import CompiledView, RegionView, field_samples
from triquad_kernels.evidence import Evidence
from triquad_kernels.surfel_map import SurfelMap, SurfelTask, first_surfels

from triquad_server.engine import make_engine
from triquad_server.field import Field
from triquad_server.field_record import region_record
from triquad_server.mesher import TileMesh, mesh_tile
from triquad_server.settings import MeshSettings
from triquad_server.threads import ANSWERS, MAPPING

_NOTICEABLE_M = 0.01
"""A surface that moves by less has not changed."""


@dataclass(frozen=True)
class TileSet:
    """Mesh tiles that may hold a surface."""

    indices: NDArray[np.int32]  # [T, 3]
    changed: NDArray[np.int64]  # [T] epoch in which each last changed


@dataclass(frozen=True)
class FrozenRegion(RegionView):
    """A region as it was when it was published."""

    field: Field
    changed: int  # epoch of its last change


class Epoch(CompiledView):
    """An immutable map: every answer comes from the same state. Safe to read from any thread."""

    def __init__(
        self,
        name: str,
        number: int,
        settings: FieldSettings,
        mesh: MeshSettings,
        regions: tuple[FrozenRegion, ...],
    ) -> None:
        super().__init__(number, settings, regions, ANSWERS.split)
        self.frozen_regions = regions
        self._name = name
        self._mesh = mesh

    @property
    def regions(self) -> int:
        """Regions of the map."""
        return len(self.frozen_regions)

    @property
    def vertices(self) -> int:
        """Quadtree vertices of all regions."""
        return sum(region.field.vertices for region in self.frozen_regions)

    @property
    def parameters(self) -> int:
        """Learnable numbers of all regions."""
        return sum(region.field.parameters for region in self.frozen_regions)

    def tiles(self, minimum: NDArray[np.float64], maximum: NDArray[np.float64]) -> TileSet:
        """Tiles that hold seen surface and meet the box between two corners [3]."""
        changed: dict[tuple[int, int, int], int] = {}
        for region in self.frozen_regions:
            for x, y, z in self._surface_tiles(region).tolist():
                changed[x, y, z] = max(region.changed, changed.get((x, y, z), 0))
        indices = np.array(sorted(changed), np.int32).reshape(-1, 3)
        low = indices * self._mesh.tile_side_m
        meets = ((low <= maximum) & (low + self._mesh.tile_side_m >= minimum)).all(axis=1)
        indices = indices[meets]
        versions = [changed[(int(x), int(y), int(z))] for x, y, z in indices]
        return TileSet(indices, np.array(versions, np.int64))

    def mesh(self, tile: tuple[int, int, int]) -> TileMesh:
        """The mesh of one tile; empty where no surface was seen."""
        return mesh_tile(self, tile, self._mesh)

    def changed(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> int:
        """Epoch of the last change to any region that meets the box; 0 where there is none."""
        half = self._settings.region_side_m / 2
        return max(
            (
                region.changed
                for region in self.frozen_regions
                if ((region.centre - half <= high) & (region.centre + half >= low)).all()
            ),
            default=0,
        )

    def record(self) -> MapRecord:
        """The epoch as a map file holds it, without training state."""
        regions = tuple(
            region_record(region.index, region.field, region.evidence, training=None)
            for region in self.frozen_regions
        )
        return MapRecord(self._name, self.number, self._settings, regions)

    def _surface_tiles(self, region: FrozenRegion) -> NDArray[np.int64]:
        """Tiles [T, 3] that meet a block with seen surface, or what is meshed around it."""
        side = BLOCK_VOXELS * self._settings.leaf_m
        corner = region.centre - self._settings.region_side_m / 2
        low = region.evidence.surface_cells() * side + corner
        first = np.floor((low - self._mesh.reach_m) / self._mesh.tile_side_m).astype(np.int64)
        last = np.floor((low + side + self._mesh.reach_m) / self._mesh.tile_side_m).astype(np.int64)
        tiles = [np.zeros((0, 3), np.int64)]
        for offset in np.ndindex(*((last - first).max(axis=0, initial=0) + 1)):
            tile = first + offset
            tiles.append(tile[(tile <= last).all(axis=1)])
        return np.unique(np.concatenate(tiles), axis=0)


@dataclass(frozen=True)
class Publication:
    """What is to be published of a live region."""

    index: RegionIndex
    settings: FieldSettings
    field: Field
    evidence: Evidence
    epoch: int
    refitted: int | None  # surfels that are fitted again at most; None: all


def frozen_region(new: Publication, before: SurfelMap | None) -> FrozenRegion:
    """A copy of a live region; ``before`` are its surfels of an earlier epoch."""
    field, evidence = new.field.copy(), new.evidence.copy()
    engine = make_engine(field)
    samples = field_samples(engine, new.settings, MAPPING.split)
    task = SurfelTask(new.epoch, new.epoch, new.refitted, _NOTICEABLE_M / new.settings.leaf_m)
    surfels = (
        first_surfels(evidence, samples, task)
        if before is None
        else before.updated(evidence, samples, task)
    )
    centre = region_centre(new.settings, new.index)
    return FrozenRegion(new.index, centre, engine, evidence, surfels, field, new.epoch)
