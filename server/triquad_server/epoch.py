"""A published, immutable state of the map, and the questions it answers."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.field_settings import FieldSettings
from triquad_format.region import (
    BLOCK_VOXELS,
    MapRecord,
    RegionIndex,
    leaf_coordinates,
    region_centre,
)
from triquad_format.status import Status
from triquad_kernels.evidence import Evidence
from triquad_kernels.region_lattice import Owned, RegionLattice

from triquad_server.engine import Engine, FieldValues, make_engine
from triquad_server.field import Field
from triquad_server.field_record import region_record
from triquad_server.mesher import TileIndex, TileMesh, mesh_tile
from triquad_server.settings import MeshSettings
from triquad_server.threads import ANSWERS, Team
from triquad_server.tile_border import TileBorder
from triquad_server.tile_lattice import TileLattice, tile_lattice, tiles_meeting


@dataclass(frozen=True)
class Answer:
    """What a map says of N points."""

    sdf: NDArray[np.float32]  # [N] metres, NaN where no region is
    status: NDArray[np.uint8]  # [N] Status values
    gradient: NDArray[np.float32] | None  # [N, 3] d(sdf)/dx, map frame


@dataclass(frozen=True)
class TileSet:
    """Mesh tiles that may hold a surface."""

    indices: NDArray[np.int32]  # [T, 3]


@dataclass(frozen=True)
class FrozenRegion:
    """A region as it was when it was published."""

    index: RegionIndex
    centre: NDArray[np.float64]  # [3] map frame
    field: Field
    engine: Engine  # that computes the field
    evidence: Evidence
    changed: int  # epoch of its last change


class Epoch:
    """An immutable map: every answer comes from the same state. Safe to read from any thread."""

    def __init__(
        self,
        name: str,
        number: int,
        settings: FieldSettings,
        mesh: MeshSettings,
        regions: tuple[FrozenRegion, ...],
    ) -> None:
        self.number = number
        self.frozen_regions = regions
        self._name = name
        self._settings = settings
        self._mesh = mesh
        self._lattice = RegionLattice(settings, [region.index for region in regions])

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

    def query(self, points: NDArray[np.float64], gradient: bool = False) -> Answer:
        """Signed distance, status and, on request, gradient at points [N, 3] of the map frame."""
        count = len(points)
        answer = Answer(
            np.empty(count, np.float32),
            np.empty(count, np.uint8),
            np.empty((count, 3), np.float32) if gradient else None,
        )

        def work(first: int, last: int) -> None:
            part = slice(first, last)
            owners = self._lattice.owners(points[part])
            groups = list(owners.groups())
            values = self._values(points[part], groups, owners.shared, gradient)
            answer.sdf[part] = values.sdf
            if answer.gradient is not None:
                answer.gradient[part] = values.gradient
            answer.status[part] = self._status(points[part], groups)

        ANSWERS.split(count, work)
        return answer

    def distances(self, points: NDArray[np.float64], team: Team = ANSWERS) -> NDArray[np.float32]:
        """Signed distances [N] alone at points [N, 3] of the map frame; ``team`` does the work."""
        distances = np.empty(len(points), np.float32)

        def work(first: int, last: int) -> None:
            part = slice(first, last)
            owners = self._lattice.owners(points[part])
            values = self._values(points[part], owners.groups(), owners.shared, gradient=False)
            distances[part] = values.sdf

        team.split(len(points), work)
        return distances

    def status(
        self,
        points: NDArray[np.float64],
        reach_m: float | None = None,
        team: Team = ANSWERS,
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

        team.split(len(points), work)
        return status

    def tiles(
        self, minimum: NDArray[np.float64], maximum: NDArray[np.float64], level: int = 0
    ) -> TileSet:
        """Tiles of a level that hold seen surface and meet the box between two corners [3]."""
        lattice = tile_lattice(self._mesh, level)
        tiles = {
            (x, y, z)
            for region in self.frozen_regions
            for x, y, z in self._surface_tiles(region, lattice).tolist()
        }
        indices = np.array(sorted(tiles), np.int32).reshape(-1, 3)
        low = indices * lattice.tile_side_m
        meets = ((low <= maximum) & (low + lattice.tile_side_m >= minimum)).all(axis=1)
        return TileSet(indices[meets])

    def mesh(
        self,
        tile: TileIndex,
        level: int = 0,
        around: TileBorder | None = None,
        team: Team = ANSWERS,
    ) -> TileMesh:
        """The mesh of one tile; empty where no surface was seen.

        ``around`` has distances at some lattice points that are used instead of the map's.
        """
        return mesh_tile(self, tile, tile_lattice(self._mesh, level), around, team)

    def record(self) -> MapRecord:
        """The epoch as a map file holds it, without training state."""
        regions = tuple(
            region_record(region.index, region.field, region.evidence, training=None)
            for region in self.frozen_regions
        )
        return MapRecord(self._name, self.number, self._settings, regions)

    def _values(
        self,
        points: NDArray[np.float64],
        groups: Iterable[Owned],
        shared: NDArray[np.bool_],
        gradient: bool,
    ) -> FieldValues:
        count = len(points)
        values = FieldValues(
            np.full(count, np.nan, np.float32),
            np.full((count if gradient else 0, 3), np.nan, np.float32),
        )
        for owned in groups:
            region = self.frozen_regions[owned.region]
            local = (points[owned.points] - region.centre).astype(np.float32)
            _put(values, owned.points, region.engine.evaluate(local, gradient))
        several = np.flatnonzero(shared)
        if len(several):
            _put(values, several, self._blend(points[several], gradient))
        return values

    def _status(
        self, points: NDArray[np.float64], groups: Iterable[Owned], reach: float = 0.5
    ) -> NDArray[np.uint8]:
        status = np.full(len(points), Status.UNKNOWN, np.uint8)
        for owned in groups:
            region = self.frozen_regions[owned.region]
            voxels = leaf_coordinates(self._settings, points[owned.points] - region.centre)
            status[owned.points] = region.evidence.status(voxels, reach)
        return status

    def _blend(self, points: NDArray[np.float64], gradient: bool) -> FieldValues:
        """Blend the regions that cover each point, so that there is no step where they overlap."""
        half = self._settings.region_side_m / 2
        weight_sum = np.zeros(len(points))
        value_sum = np.zeros(len(points))
        slope_sum = np.zeros((len(points), 3))  # of weight * value
        tilt_sum = np.zeros((len(points), 3))  # of weight
        for region in self.frozen_regions:
            offsets = points - region.centre
            mine = np.flatnonzero((np.abs(offsets) < half).all(axis=1))
            if len(mine) == 0:
                continue
            inside = half - np.abs(offsets[mine])
            ramps = np.clip(inside / self._settings.overlap_m, 0, 1)
            weights = ramps.prod(axis=1)
            values = region.engine.evaluate(offsets[mine].astype(np.float32), gradient)
            weight_sum[mine] += weights
            value_sum[mine] += weights * values.sdf
            if gradient:
                tilt = _ramp_gradient(offsets[mine], ramps, self._settings.overlap_m)
                slope_sum[mine] += weights[:, None] * values.gradient + tilt * values.sdf[:, None]
                tilt_sum[mine] += tilt
        with np.errstate(invalid="ignore", divide="ignore"):
            sdf = value_sum / weight_sum
            slopes = (slope_sum - sdf[:, None] * tilt_sum) / weight_sum[:, None]
        slopes = slopes[: len(points) if gradient else 0]
        return FieldValues(sdf.astype(np.float32), slopes.astype(np.float32))

    def _surface_tiles(self, region: FrozenRegion, lattice: TileLattice) -> NDArray[np.int64]:
        """Tiles [T, 3] that meet a block with seen surface, or what is meshed around it."""
        side = BLOCK_VOXELS * self._settings.leaf_m
        corner = region.centre - self._settings.region_side_m / 2
        low = region.evidence.surface_cells() * side + corner
        return tiles_meeting(low, low + side, lattice.reach_m, lattice)


def frozen_region(
    index: RegionIndex,
    settings: FieldSettings,
    field: Field,
    evidence: Evidence,
    changed: int,
) -> FrozenRegion:
    """A copy of a live region for publication."""
    twin = field.copy()
    return FrozenRegion(
        index,
        region_centre(settings, index),
        twin,
        make_engine(twin),
        evidence.copy(),
        changed,
    )


def _put(values: FieldValues, where: slice | NDArray[np.int64], new: FieldValues) -> None:
    """Put ``new`` values in their places."""
    values.sdf[where] = new.sdf
    if len(values.gradient):
        values.gradient[where] = new.gradient


def _ramp_gradient(
    offsets: NDArray[np.float64],
    ramps: NDArray[np.float64],
    overlap_m: float,
) -> NDArray[np.float64]:
    """Gradient [N, 3] of the product of the three ramps."""
    slopes = np.where((ramps > 0) & (ramps < 1), -np.sign(offsets) / overlap_m, 0.0)
    others = np.stack(
        [ramps[:, 1] * ramps[:, 2], ramps[:, 0] * ramps[:, 2], ramps[:, 0] * ramps[:, 1]],
        axis=1,
    )
    return slopes * others
