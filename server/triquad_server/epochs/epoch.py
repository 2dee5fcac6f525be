"""A published, immutable state of the map, and the questions it answers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import BLOCK_VOXELS, MapRecord, RegionIndex, region_centre
from triquad_map.compiled.compiled_view import CompiledView, RegionView
from triquad_map.compiled.evidence.live_evidence import LiveEvidence
from triquad_map.compiled.surfels.surfel_map import SurfelMap, SurfelTask, first_surfels
from triquad_map.composition.field_samples import field_samples

from triquad_server.engine.engine import make_engine
from triquad_server.engine.field import Field
from triquad_server.engine.field_record import region_record
from triquad_server.mesh.mesher import TileIndex, TileMesh, mesh_tile
from triquad_server.mesh.tile_lattice import TileLattice, tile_lattice, tiles_meeting
from triquad_server.settings import MeshSettings
from triquad_server.threads import ANSWERS, MAPPING


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
    def number(self) -> int:
        """Number of this epoch."""
        return self.epoch

    @property
    def regions(self) -> int:
        """Regions of the map."""
        return len(self.frozen_regions)

    @property
    def field_settings(self) -> FieldSettings:
        """Shape of the field."""
        return self._settings

    @property
    def vertices(self) -> int:
        """Quadtree vertices of all regions."""
        return sum(region.field.vertices for region in self.frozen_regions)

    @property
    def parameters(self) -> int:
        """Learnable numbers of all regions."""
        return sum(region.field.parameters for region in self.frozen_regions)

    def tiles(
        self, minimum: NDArray[np.float64], maximum: NDArray[np.float64], level: int = 0
    ) -> NDArray[np.int32]:
        """Tiles [T, 3] of a level that hold seen surface and meet the box of two corners [3]."""
        lattice = tile_lattice(self._mesh, level)
        tiles = {
            (x, y, z)
            for region in self.frozen_regions
            for x, y, z in self._surface_tiles(region, lattice).tolist()
        }
        indices = np.array(sorted(tiles), np.int32).reshape(-1, 3)
        low = indices * lattice.tile_side_m
        meets = ((low <= maximum) & (low + lattice.tile_side_m >= minimum)).all(axis=1)
        return np.asarray(indices[meets])

    def mesh(self, tile: TileIndex, level: int = 0) -> TileMesh:
        """The mesh of one tile; empty where no surface was seen."""
        return mesh_tile(self, tile, tile_lattice(self._mesh, level))

    def record(self) -> MapRecord:
        """The epoch as a map file holds it, without training state."""
        regions = tuple(
            region_record(region.index, region.field, region.evidence, training=None)
            for region in self.frozen_regions
        )
        return MapRecord(self._name, self.number, self._settings, regions)

    def _surface_tiles(self, region: FrozenRegion, lattice: TileLattice) -> NDArray[np.int64]:
        """Tiles [T, 3] that meet a block with seen surface, or what is meshed around it."""
        side = BLOCK_VOXELS * self._settings.leaf_m
        corner = region.centre - self._settings.region_side_m / 2
        low = region.evidence.surface_cells() * side + corner
        return tiles_meeting(low, low + side, lattice.reach_m, lattice)


@dataclass(frozen=True)
class Publication:
    """What is to be published of a live region."""

    index: RegionIndex
    settings: FieldSettings
    field: Field
    evidence: LiveEvidence
    epoch: int
    refitted: int | None  # surfels that are fitted again at most; None: all


def frozen_region(new: Publication, before: SurfelMap | None) -> FrozenRegion:
    """A copy of a live region; ``before`` are its surfels of an earlier epoch."""
    field, evidence = new.field.copy(), new.evidence.freeze()
    engine = make_engine(field)
    samples = field_samples(engine, new.settings, MAPPING.split)
    task = SurfelTask(new.epoch, new.refitted)
    surfels = (
        first_surfels(evidence, samples, task)
        if before is None
        else before.updated(evidence, samples, task)
    )
    centre = region_centre(new.settings, new.index)
    return FrozenRegion(new.index, centre, engine, evidence, surfels, field, new.epoch)
