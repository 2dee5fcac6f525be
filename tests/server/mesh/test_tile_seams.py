"""Tiles meet whenever they were made: together they are the mesh of the map in one piece."""

import functools
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from support.maps.exact_maps import flat
from support.maps.meshed_ground import MESH, bump, ground, make_all, shown, surfaces, to_make
from support.maps.small_world import settings, world
from triquad_format.wire.limits import LEVELS
from triquad_format.wire.tile_codec import TileSurface
from triquad_map.mesh.tile_mesh import TileIndex, TileLattice, mesh_tile
from triquad_server.epochs.epoch import Epoch
from triquad_server.mapping.mapper import Mapper
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.process.threads import Teams
from triquad_server.settings import MeshSettings
from triquad_tools.simulation.lidar import SimulatedScan

TEAM = Teams().background


def triangles(tiles: Iterable[tuple[TileIndex, TileSurface]], cells: int) -> NDArray[np.int64]:
    """Triangles [N, 15] of tiles: for each corner its lattice edge and how far along it is."""
    rows = []
    for index, surface in tiles:
        points = surface.points.astype(np.int64) + np.array(index) * cells
        vertices = np.column_stack([points, surface.axes, surface.steps])
        rows.append(vertices[surface.faces].reshape(-1, 15))
    return np.unique(np.concatenate(rows), axis=0)


@dataclass
class Patchwork:
    """A map of many epochs: in each tile the one of which the cache made it.

    On the tiles' faces the distances are those that the cache used.
    """

    lattice: TileLattice
    epochs: dict[TileIndex, Epoch]
    borders: dict[tuple[int, int, int], float]

    def distances_in_grid(
        self, axes: NDArray[np.float64], points: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        steps = np.rint(axes / self.lattice.cell_m).astype(np.int64)[:, 0] + points
        values = np.ones(len(points), np.float32)
        for index, rows in self._owned(steps).items():
            values[rows] = self.epochs[index].distances_in_grid(axes, points[rows])
        for row in np.flatnonzero((steps % self.lattice.cells == 0).any(axis=1)):
            values[row] = self.borders.get(tuple(steps[row].tolist()), 1.0)
        return values

    def surface_in_grid(self, axes: NDArray[np.float64], reach_m: float) -> NDArray[np.bool_]:
        surface = np.zeros(axes.shape[1:] * 3, np.bool_)
        tiles = np.floor(axes / self.lattice.tile_side_m)
        for index, epoch in self.epochs.items():
            mine = [np.flatnonzero(of == at) for of, at in zip(tiles, index, strict=True)]
            if all(map(len, mine)):
                inner = np.stack([axis[rows] for axis, rows in zip(axes, mine, strict=True)])
                surface[np.ix_(*mine)] = epoch.surface_in_grid(inner, reach_m)
        return surface

    def status(self, points: NDArray[np.float64], reach_m: float) -> NDArray[np.uint8]:
        status = np.zeros(len(points), np.uint8)
        for index, rows in self._owned(points / self.lattice.cell_m).items():
            status[rows] = self.epochs[index].status(points[rows], reach_m)
        return status

    def near_ends(self, points: NDArray[np.float64], reach_m: float) -> NDArray[np.bool_]:
        near = np.zeros(len(points), np.bool_)
        for index, rows in self._owned(points / self.lattice.cell_m).items():
            near[rows] = self.epochs[index].near_ends(points[rows], reach_m)
        return near

    @property
    def voxel_m(self) -> float:
        return next(iter(self.epochs.values())).voxel_m

    def _owned(self, steps: NDArray[np.floating]) -> dict[TileIndex, NDArray[np.intp]]:
        tiles = np.floor(steps / self.lattice.cells).astype(np.int64)
        _, first, inverse = np.unique(tiles @ (10**6, 10**3, 1), True, True)
        owned = {(x, y, z): row for row, (x, y, z) in enumerate(tiles[first].tolist())}
        return {
            index: np.flatnonzero(inverse.ravel() == row)
            for index, row in owned.items()
            if index in self.epochs
        }


def patchwork(cache: TileCache, epochs: dict[int, Epoch], level: int) -> Patchwork:
    lattice = cache.lattice(level)
    made: dict[TileIndex, Epoch] = {}
    borders: dict[tuple[int, int, int], float] = {}
    for index, tile in cache._levels[level].tiles.items():
        made[index] = epochs[tile.made]
        points = tile.border.points + np.array(index) * lattice.cells
        for point, value in zip(points.tolist(), tile.border.values.tolist(), strict=True):
            key = (point[0], point[1], point[2])
            assert borders.setdefault(key, value) == value, "two tiles disagree on a lattice point"
    return Patchwork(lattice, made, borders)


def strip(scan: SimulatedScan, low_m: float) -> NDArray[np.float32]:
    """The points of a scan in a strip of 2.5 m across the street."""
    ends = scan.points @ scan.world_from_sensor[0, :3] + scan.world_from_sensor[0, 3]
    return scan.points[(ends > low_m) & (ends < low_m + 2.5)]


@functools.cache
def seen_in_strips() -> tuple[Epoch, ...]:
    """Epochs of a street of which more and more is seen, with training in between."""
    mapper = Mapper("test", settings(), "cpu")
    epochs: list[Epoch] = []
    for number, scan in enumerate(world(6).scans):
        points = scan.points if number == 0 else strip(scan, 1.5 * number)
        mapper.ingest(points, scan.world_from_sensor)
        for _ in range(30):
            mapper.train()
        epochs.append(mapper.publish())
    return tuple(epochs)


def test_who_knows_an_epoch_is_told_what_changes_within_it() -> None:
    """A tile that no longer fits its new neighbour is made again, and all who have it fetch it."""
    cache = TileCache(MeshSettings(tile_cells=16, tolerance_m=0.03), TEAM)
    box = (np.array([0.0, -8, -2]), np.array([10.0, 8, 6]))
    told = 0
    for epoch in seen_in_strips():
        cache.refresh(epoch)
        for index in to_make(cache, 0, box):
            known = cache.revision(0)
            cache.make(0, index)
            changed = cache.changed(0, *box, known)
            assert index not in changed
            assert all(cache.kept(0, other) is None for other in changed)
            told += len(changed)
    assert told > 0


@pytest.mark.parametrize(
    "level", [0, *(pytest.param(level, marks=pytest.mark.long) for level in range(1, LEVELS))]
)
def test_tiles_made_at_different_times_are_one_mesh(level: int) -> None:
    """After partial updates, all tiles have the triangles that meshing in one piece gives."""
    chosen = MeshSettings(tile_cells=16, cell_m=0.1 / 2**level, tolerance_m=0.03)
    cache = TileCache(chosen, TEAM)
    epochs = {epoch.number: epoch for epoch in seen_in_strips()}
    some_kept = 0
    for epoch in epochs.values():
        cache.refresh(epoch)
        low, high = np.array([0.0, -8, -2]), np.array([10.0, 8, 6])
        wanted = to_make(cache, level, (low, high))
        some_kept += len(cache.changed(level, low, high, 0)) - len(wanted)
        while wanted:  # also those that no longer fit their new neighbours
            for index in wanted[::-1]:
                cache.make(level, index)
            wanted = to_make(cache, level, (low, high))
    assert some_kept > 50
    assert len({tile.version for tile in shown(cache, level).values()}) > 3

    lattice = cache.lattice(level)
    whole = replace(lattice, cells=128)
    source = patchwork(cache, epochs, level)
    apart = surfaces(cache, level)
    compared = 0
    for index in [(0, -1, 0), (0, 0, 0), (0, -1, -1), (0, 0, -1)]:
        inside = {
            small: surface
            for small, surface in apart.items()
            if tuple(coordinate // 8 for coordinate in small) == index
        }
        one_piece = mesh_tile(source, index, whole).surface
        expected = triangles([(index, one_piece)], 128)
        np.testing.assert_array_equal(triangles(inside.items(), lattice.cells), expected)
        compared += len(expected)
    assert compared > 3000


def test_tiles_made_at_the_same_time_meet_as_those_made_one_by_one() -> None:
    together, alone = TileCache(MESH, TEAM), TileCache(MESH, TEAM)
    epochs: dict[int, Epoch] = {}
    for epoch in (ground(flat(0.3)), bump(4.0, 0.05), bump(3.0, 0.05)):
        epochs[epoch.number] = epoch
        together.refresh(epoch)
        while missing := to_make(together):
            assert missing[0] in together.make_some(0, missing)
        if len(epochs) == 1:
            alone.refresh(epoch)
            make_all(alone)
            pair = [triangles(surfaces(cache).items(), 16) for cache in (together, alone)]
            np.testing.assert_array_equal(*pair)
        patchwork(together, epochs, 0)  # on their faces, all of them say the same
