"""Tiles are made where the surface changed, and there alone."""

from dataclasses import replace

import numpy as np
import pytest
from support.maps.exact_maps import SETTINGS, exact_map, flat
from support.maps.meshed_ground import (
    EVERYWHERE,
    MESH,
    bump,
    ground,
    make_all,
    shown,
    surfaces,
    to_make,
)
from triquad_format.records.region import seen_voxels
from triquad_format.wire.limits import LEVELS
from triquad_format.wire.tile_codec import decode_tile
from triquad_map.mesh.tile_mesh import TileIndex
from triquad_server.epochs.epoch import Epoch
from triquad_server.mapping.mapper import Mapper
from triquad_server.mesh.tile_cache import TileCache, tile_lattice
from triquad_server.process.threads import Teams
from triquad_server.settings import MeshSettings, Settings

TEAM = Teams().background


def versions(cache: TileCache, level: int = 0) -> dict[TileIndex, int]:
    return {index: tile.version for index, tile in shown(cache, level).items()}


@pytest.mark.parametrize("level", [0, LEVELS - 1])
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


def cut(quarters: int) -> Epoch:
    """A ground in whose last voxels towards greater x no ray ended so far from that side."""
    (region,) = exact_map(flat(0.3)).regions
    voxels = seen_voxels(region.evidence, region.evidence.surface)
    margins = np.zeros((len(voxels), 6), np.uint8)
    margins[voxels[:, 0] == voxels[:, 0].max(), 3] = quarters
    return ground(flat(0.3), evidence=replace(region.evidence, margins=margins))


def test_tiles_follow_where_within_voxels_the_surface_ends() -> None:
    cache = TileCache(MESH, TEAM)
    cache.refresh(cut(0))
    first = make_all(cache)
    last = max(x for x, _, _ in surfaces(cache))
    at_edge = {index for index in first if index[0] == last}
    for quarters, changes in ((1, False), (3, True), (2, False), (0, True)):
        before = surfaces(cache)
        cache.refresh(cut(quarters))
        made = set(make_all(cache))
        assert bool(made) == changes
        assert made <= at_edge
        assert not made or set(before) & at_edge <= made


def test_surface_that_is_forgotten_goes_and_everybody_is_told() -> None:
    chosen = Settings(field=SETTINGS, mesh=MESH)
    mapper = Mapper("test", chosen, "cpu", exact_map(flat(0.3)))
    cache = TileCache(MESH, TEAM)
    cache.refresh(mapper.publish())
    make_all(cache)
    before = surfaces(cache)
    known = cache.revision(0)
    mapper.reset(np.array([0.0, -50, -50]), np.array([200.0, 50, 50]))
    cache.refresh(mapper.publish())
    made = make_all(cache)
    side_m = cache.lattice(0).tile_side_m
    assert all((x + 1) * side_m > -0.5 for x, _, _ in made), "only what is near the box"
    far = {index for index in before if index[0] * side_m > 0.5}
    assert far
    told = cache.changed(0, *EVERYWHERE, known)
    emptied = [cache.kept(0, index) for index in far & told.keys()]
    assert len(emptied) == len(far)
    assert not any(len(decode_tile(tile.data).faces) for tile in emptied if tile is not None)
    assert not far & set(surfaces(cache))


def test_who_knows_everything_is_told_nothing() -> None:
    cache = TileCache(MESH, TEAM)
    first = ground(flat(0.3))
    cache.refresh(first)
    make_all(cache)
    known = cache.revision(0)
    assert cache.changed(0, *EVERYWHERE, known) == {}
    second = bump(4.0, 0.05)
    cache.refresh(second)
    told = cache.changed(0, *EVERYWHERE, known)
    assert 0 < len(told) < len(cache.changed(0, *EVERYWHERE, 0))
    assert set(told.values()) == {second.number}
    cache.refresh(first)  # an older one tells nothing
    assert cache.changed(0, *EVERYWHERE, cache.revision(0)) == {}


def test_tiles_whose_bytes_went_are_made_again_and_stay_the_same() -> None:
    cache = TileCache(MeshSettings(tile_cells=16, cache_bytes=2000), TEAM)
    epoch = ground(flat(0.3))
    cache.refresh(epoch)
    made = {index: cache.make(0, index) for index in to_make(cache)}
    kept = [tile.data for index in made if (tile := cache.kept(0, index)) is not None]
    assert sum(map(len, kept)) <= 2000
    gone = [index for index in made if cache.kept(0, index) is None]
    assert len(gone) > len(made) / 4
    for index in gone:
        again = cache.make(0, index)
        assert (again.version, again.data) == (made[index].version, made[index].data)
    assert cache.changed(0, *EVERYWHERE, cache.revision(0)) == {}


def test_tiles_of_an_epoch_are_kept_apart_from_those_that_are_followed() -> None:
    cache = TileCache(MESH, TEAM)
    view = ground(flat(0.3)).in_one_thread()
    first = cache.of_epoch(view, 0, [(0, 0, 0), (1, 0, 0)], 0.0)
    again = cache.of_epoch(view, 0, [(1, 0, 0), (0, 0, 0)], 0.0)
    assert [id(tile) for tile in again] == [id(tile) for tile in first[::-1]]
    (filled,) = cache.of_epoch(view, 0, [(0, 0, 0)], 0.5)
    assert filled is not first[0]
    assert cache.kept(0, (0, 0, 0)) is None
    assert cache._shown.size == sum(tile.nbytes for tile in (*first, filled))
