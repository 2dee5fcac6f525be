"""Maps that are kept open, tiles that are kept, and checkpoints that come and go."""

from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from support.changing_store import EMPTY, box_at, write_checkpoint
from triquad_client import ClosedError
from triquad_tools.console.command import ToolError
from triquad_tools.viewer.sources.file_source import FileSource
from triquad_tools.viewer.sources.history import DamagedError, History
from triquad_tools.viewer.sources.history_source import newest_of
from triquad_tools.viewer.sources.map_source import COARSEST
from triquad_tools.viewer.sources.open_maps import OpenMaps
from triquad_tools.viewer.sources.tile_cache import MadeTile, TileCache

ORIGIN = [[0.0, 0.0, 1.0]]


@pytest.fixture
def maps() -> Iterator[OpenMaps]:
    with closing(OpenMaps(kept=2)) as maps:
        yield maps


def tile(count: int) -> MadeTile:
    vertices = np.zeros((count, 3), np.float32)
    return MadeTile(1, np.zeros(3), vertices, faces=np.zeros((0, 3), np.int32))


def test_tiles_are_kept_up_to_so_many_bytes() -> None:
    cache = TileCache(max_bytes=3 * tile(10).size_bytes)
    for name in "abc":
        cache.put(name, tile(10))
    assert cache.get("a") is not None  # used again: others go first
    cache.put("d", tile(10))
    assert [name for name in "abcd" if cache.get(name) is not None] == ["a", "c", "d"]
    cache.put("a", tile(20))
    assert cache.size_bytes <= 3 * tile(10).size_bytes


def test_few_maps_stay_open_but_those_in_use_do(tmp_path: Path, maps: OpenMaps) -> None:
    paths = [write_checkpoint(tmp_path, epoch, EMPTY) for epoch in (1, 2, 3, 4)]
    used = maps.use(paths[0])
    others: list[FileSource] = []
    for path in paths[1:]:
        others.append(maps.use(path))
        maps.release(path)
    assert maps.use(paths[0]) is used
    used.queries.query_sdf(ORIGIN)
    assert maps.use(paths[3]) is others[2], "the last one is open still"
    with pytest.raises(ClosedError):
        others[0].queries.query_sdf(ORIGIN)


def test_tiles_of_a_file_are_its_mesh(tmp_path: Path, maps: OpenMaps) -> None:
    source = maps.use(write_checkpoint(tmp_path, 1, box_at(3, 3)))
    whole = source.opened.mesh(cell_m=source.sizes.cell_of(COARSEST))
    follower = source.follow(COARSEST)
    follower.wait(60.0)
    assert follower.complete
    assert sum(len(tile.faces) for tile in follower.tiles.values()) == len(whole.faces)
    for index, made in follower.tiles.items():
        side_m = source.sizes.side_of(COARSEST)
        np.testing.assert_allclose(made.origin, np.array(index) * side_m)
    again = source.follow(COARSEST)
    again.wait(60.0)
    assert all(again.tiles[index] is made for index, made in follower.tiles.items())


def test_a_box_has_the_tiles_that_meet_it(tmp_path: Path, maps: OpenMaps) -> None:
    source = maps.use(write_checkpoint(tmp_path, 1, EMPTY))
    follower = source.follow(0, ((1.0, 1.0, 0.0), (2.0, 2.0, 1.0)))
    follower.wait(60.0)
    assert set(follower.tiles) == {(0, 0, 0)}
    moved = follower.moved(((-2.0, 1.0, 0.0), (2.0, 2.0, 1.0)))
    assert set(moved.tiles) == {(0, 0, 0)}, "what both have is there at once"
    moved.wait(60.0)
    assert set(moved.tiles) == {(0, 0, 0), (-1, 0, 0)}


def test_checkpoints_come_and_go(tmp_path: Path, maps: OpenMaps) -> None:
    first = write_checkpoint(tmp_path, 1, EMPTY)
    history = History(tmp_path, maps)
    write_checkpoint(tmp_path, 2, EMPTY)
    assert [moment.epoch for moment in history.moments] == [1]
    history.refresh()
    assert [moment.epoch for moment in history.moments] == [1, 2]
    first.unlink()
    history.refresh()
    assert [str(moment) for moment in history.moments] == ["epoch 2, 2026-01-31T14:00:00Z"]
    assert history.damaged == ()


def flip(path: Path) -> None:
    """Damage a part, which only reading all of the file shows."""
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 0x10
    path.write_bytes(data)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1000])


@pytest.mark.parametrize("damage", [flip, cut])
def test_damaged_checkpoints_are_named_and_left_out(
    tmp_path: Path, maps: OpenMaps, damage: Callable[[Path], None]
) -> None:
    write_checkpoint(tmp_path, 1, EMPTY)
    damage(write_checkpoint(tmp_path, 2, EMPTY))
    history = History(tmp_path, maps)
    with closing(newest_of(history)) as source:
        assert source.moment.epoch == 1
        assert [moment.epoch for moment in history.moments] == [1]
        (problem,) = history.damaged
        assert problem.startswith("epoch-000000002.triquad is left out: ")


def test_another_moment_is_shown_once_it_is_known(tmp_path: Path, maps: OpenMaps) -> None:
    write_checkpoint(tmp_path, 1, EMPTY)
    write_checkpoint(tmp_path, 2, box_at(3, 3))
    history = History(tmp_path, maps)
    first, second = history.moments
    with closing(newest_of(history)) as source:
        follower = source.follow(COARSEST)
        follower.refresh()
        assert {tile.version for tile in follower.tiles.values()} == {2}
        source.move(first)
        assert source.state().epoch == 1
        assert {tile.version for tile in follower.tiles.values()} == {2}
        follower.refresh()
        assert {tile.version for tile in follower.tiles.values()} == {1}
        flip(second.path)
        source.move(second)  # it is open still
        follower.close()


def test_the_one_before_stays_where_another_cannot_be_shown(tmp_path: Path, maps: OpenMaps) -> None:
    write_checkpoint(tmp_path, 1, EMPTY)
    flip(write_checkpoint(tmp_path, 2, EMPTY))
    write_checkpoint(tmp_path, 3, EMPTY)
    history = History(tmp_path, maps)
    with closing(newest_of(history)) as source:
        with pytest.raises(DamagedError, match="epoch-000000002"):
            source.move(history.moments[1])
        assert source.state().epoch == 3
        source.queries.query_sdf(ORIGIN)
        assert [moment.epoch for moment in history.moments] == [1, 3]


def test_a_store_of_which_nothing_is_left(tmp_path: Path, maps: OpenMaps) -> None:
    flip(write_checkpoint(tmp_path, 1, EMPTY))
    with pytest.raises(ToolError, match="no checkpoint can be shown"):
        newest_of(History(tmp_path, maps))
