"""Tiles that are made where the surface changed, and that meet whenever they were made."""

import functools
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from support.maps.exact_maps import SETTINGS, exact_map, flat
from support.maps.small_world import settings, settle, world
from triquad_format.wire.limits import LEVELS
from triquad_format.wire.tile_codec import TileSurface, decode_tile
from triquad_map.mesh.mesher import mesh_tile
from triquad_map.mesh.tile_lattice import TileIndex, TileLattice
from triquad_server.epochs.epoch import Epoch
from triquad_server.mapping.mapper import Mapper
from triquad_server.mesh.tile_cache import TileCache, tile_lattice
from triquad_server.process.threads import Teams
from triquad_server.settings import MeshSettings, Settings
from triquad_tools.simulation.lidar import SimulatedScan

EVERYWHERE = np.full(3, -np.inf), np.full(3, np.inf)
MESH = MeshSettings(tile_cells=16)
TEAM = Teams().meshing


def make_all(cache: TileCache, level: int = 0) -> list[TileIndex]:
    """Make what has to be made; returns it."""
    made: list[TileIndex] = []
    while to_make := cache.delta(level, *EVERYWHERE, 0, {}).to_make:
        for index in to_make:
            cache.make(level, index)
        made += to_make
    return made


def surfaces(cache: TileCache, level: int = 0) -> dict[TileIndex, TileSurface]:
    """All tiles with faces, decoded."""
    found = {}
    for tile in cache.delta(level, *EVERYWHERE, 0, {}).ready:
        assert not tile.empty, "a client without tiles is not sent empty ones"
        data = cache.data(level, tile)
        assert data is not None
        found[tile.index] = decode_tile(data)
    return found


def versions(cache: TileCache, level: int = 0) -> dict[TileIndex, int]:
    return {tile.index: tile.version for tile in cache.delta(level, *EVERYWHERE, 0, {}).ready}


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
        wanted = cache.delta(level, low, high, 0, {})
        some_kept += len(wanted.ready)
        while wanted.to_make:  # also those that no longer fit what was made beside them
            for index in wanted.to_make[::-1]:
                cache.make(level, index)
            wanted = cache.delta(level, low, high, 0, {})
    assert some_kept > 50
    assert len(set(versions(cache, level).values())) > 3

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


def bump(where: float, height_m: float) -> Epoch:
    """A flat ground at 0.3 m, with the square 2 m around (where, where) raised."""

    def height(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        near = np.maximum(np.abs(x - where), np.abs(y - where)) < 1.0
        return np.where(near, 0.3 + height_m, 0.3)

    return ground(height)


_EPOCHS = iter(range(1, 1000))


def ground(height: object) -> Epoch:
    record = exact_map(height, epoch=next(_EPOCHS))  # type: ignore[arg-type]
    return Mapper("test", Settings(field=SETTINGS, mesh=MESH), "cpu", record).publish()


@pytest.mark.parametrize("level", range(LEVELS))
def test_only_tiles_whose_surface_moved_are_made_again(level: int) -> None:
    cache = TileCache(MESH, TEAM)
    cache.refresh(ground(flat(0.3)))
    first = make_all(cache, level)
    before = versions(cache, level)
    side_m = tile_lattice(MESH, level).tile_side_m
    epoch = bump(4.0, 0.05)
    cache.refresh(epoch)
    made = make_all(cache, level)
    low, high = np.floor(2.6 / side_m), np.floor(5.4 / side_m)
    assert {(x, y) for x, y, _ in made} == {
        (x, y) for x, y, _ in first if low <= x <= high and low <= y <= high
    }
    after = versions(cache, level)
    for index, version in after.items():
        assert version == (epoch.number if index in made else before[index])
    assert len(made) < len(first)


def test_what_moves_by_less_than_the_tolerance_changes_nothing_until_it_adds_up() -> None:
    cache = TileCache(MESH, TEAM)
    cache.refresh(ground(flat(0.3)))
    make_all(cache)
    for height_m in (0.306, 0.302, 0.294):
        cache.refresh(ground(flat(height_m)))
        assert make_all(cache) == []
    cache.refresh(ground(flat(0.3001)))
    assert make_all(cache) == []
    cache.refresh(ground(flat(0.312)))
    assert len(make_all(cache)) > 100


def test_surface_that_is_forgotten_goes_and_everybody_is_told() -> None:
    chosen = settings().model_copy(update={"mesh": MESH})
    mapper = Mapper("test", chosen, "cpu")
    for scan in world(2).scans:
        mapper.ingest(scan.points, scan.world_from_sensor)
    settle(mapper)
    cache = TileCache(MESH, TEAM)
    cache.refresh(mapper.publish())
    make_all(cache)
    before = surfaces(cache)
    known = cache.revision
    mapper.reset(np.array([0.0, -50, -50]), np.array([200.0, 50, 50]))
    cache.refresh(mapper.publish())
    made = make_all(cache)
    side_m = cache.lattice(0).tile_side_m
    assert all((x + 1) * side_m > -0.5 for x, _, _ in made), "only what is near the box"
    delta = cache.delta(0, *EVERYWHERE, known, {})
    far = {index for index in before if index[0] * side_m > 0.5}
    assert far
    assert far <= {tile.index for tile in delta.ready if tile.empty}
    assert not far & set(surfaces(cache))


def test_who_knows_everything_is_told_nothing() -> None:
    cache = TileCache(MESH, TEAM)
    cache.refresh(ground(flat(0.3)))
    make_all(cache)
    delta = cache.delta(0, *EVERYWHERE, cache.revision, {})
    assert (delta.ready, delta.removed, delta.to_make) == ([], [], [])
    known = versions(cache)
    delta = cache.delta(0, *EVERYWHERE, 0, known)
    assert (delta.ready, delta.removed, delta.to_make) == ([], [], [])
    index = min(known)
    delta = cache.delta(0, *EVERYWHERE, 0, known | {index: 77, (500, 0, 0): 1})
    assert [tile.index for tile in delta.ready] == [index]
    assert delta.removed == [(500, 0, 0)]


def test_no_tile_is_made_again_before_all_were_made() -> None:
    """While the whole map changes with each epoch, as it does in training, all of it appears."""
    cache = TileCache(MESH, TEAM)
    cache.refresh(ground(flat(0.3)))
    made: list[TileIndex] = []
    for time in range(6):
        made.append(cache.delta(0, *EVERYWHERE, 0, {}).to_make[0])
        cache.make(0, made[-1])
        cache.refresh(ground(flat(0.32 if time % 2 else 0.34)))
    assert len(set(made)) == 6
    # After all the others those come first that were made longest ago.
    assert cache.delta(0, *EVERYWHERE, 0, {}).to_make[-6:] == made


def test_tiles_made_at_the_same_time_meet_as_those_made_one_by_one() -> None:
    together, alone = TileCache(MESH, TEAM), TileCache(MESH, TEAM)
    epochs: dict[int, Epoch] = {}
    for epoch in (ground(flat(0.3)), bump(4.0, 0.05), bump(3.0, 0.05)):
        epochs[epoch.number] = epoch
        together.refresh(epoch)
        while to_make := together.delta(0, *EVERYWHERE, 0, {}).to_make:
            made = together.make_some(0, to_make)
            assert made[0] == to_make[0]
            assert len(made) == len(set(made))
        if len(epochs) == 1:
            alone.refresh(epoch)
            make_all(alone)
            pair = [triangles(surfaces(cache).items(), 16) for cache in (together, alone)]
            np.testing.assert_array_equal(*pair)
        patchwork(together, epochs, 0)  # on their faces, all of them say the same


def test_tiles_whose_bytes_went_are_made_again_and_stay_the_same() -> None:
    cache = TileCache(MeshSettings(tile_cells=16, cache_bytes=2000), TEAM)
    epoch = ground(flat(0.3))
    cache.refresh(epoch)
    made = make_all(cache)
    ready = cache.delta(0, *EVERYWHERE, 0, {}).ready
    kept = [data for tile in ready if (data := cache.data(0, tile)) is not None]
    assert sum(map(len, kept)) <= 2000
    gone = [tile for tile in ready if cache.data(0, tile) is None]
    assert len(gone) > len(made) / 4
    revision = cache.revision
    for tile in gone:
        again = cache.make(0, tile.index)
        assert (again.digest, again.version, again.revision) == (
            tile.digest,
            tile.version,
            tile.revision,
        )
    assert cache.revision == revision


def test_when_tiles_changed_is_told_for_any_of_them() -> None:
    cache = TileCache(MESH, TEAM)
    first = ground(flat(0.3))
    cache.refresh(first)
    second = bump(4.0, 0.05)
    cache.refresh(second)
    cache.refresh(first)  # an older one tells nothing
    asked = np.array([[2, 2, 0], [-2, -2, 0], [900, 0, 0]])
    assert cache.changed(0, asked).tolist() == [second.number, first.number, 0]
