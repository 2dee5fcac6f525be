"""Maps that stay open, tiles that are made, and checkpoints that come and go."""

import gc
import weakref
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.files.changing_store import EMPTY, box_at, write_checkpoint
from support.files.file_damage import rot
from triquad_format.errors import DamagedMapFileError
from triquad_tools.viewer.sources import (
    COARSEST,
    DamagedError,
    FileSource,
    History,
    StoredTiles,
    moment,
)

ORIGIN = [[0.0, 0.0, 1.0]]


def completed(follower: StoredTiles) -> StoredTiles:
    while not follower.complete:
        follower.next(0.0)
    return follower


def epochs(history: History) -> list[int]:
    return [file.epoch for file in history.files()]


def test_few_maps_stay_open_but_those_that_are_shown_do(tmp_path: Path) -> None:
    for epoch in range(1, 7):
        write_checkpoint(tmp_path, epoch, EMPTY)
    history = History(tmp_path)
    first, *rest = history.files()
    shown = history.opened(first)
    others = [weakref.ref(history.opened(file)) for file in rest]
    gc.collect()
    assert [other() is None for other in others] == [True, False, False, False, False]
    shown.queries.query_sdf(ORIGIN)
    assert history.opened(rest[-1]) is others[4](), "the last one is open still"


def test_tiles_of_a_file_are_its_mesh(tmp_path: Path) -> None:
    source = FileSource(write_checkpoint(tmp_path, 1, box_at(3, 3)), "file")
    whole = source.queries.mesh(cell_m=source.sizes.cell_of(COARSEST))
    tiles = completed(source.follow(COARSEST)).tiles
    assert sum(len(tile.faces) for tile in tiles.values()) == len(whole.faces)
    for index, made in tiles.items():
        np.testing.assert_allclose(made.origin, np.array(index) * source.sizes.side_of(COARSEST))
    again = completed(source.follow(COARSEST)).tiles
    assert all(again[index] is made for index, made in tiles.items()), "they are made once"


def test_a_box_has_the_tiles_that_meet_it(tmp_path: Path) -> None:
    source = FileSource(write_checkpoint(tmp_path, 1, EMPTY), "file")
    follower = completed(source.follow(0, ((1.0, 1.0, 0.0), (2.0, 2.0, 1.0))))
    assert set(follower.tiles) == {(0, 0, 0)}
    moved = source.follow(0, ((-2.0, 1.0, 0.0), (2.0, 2.0, 1.0)), follower)
    assert set(moved.tiles) == {(0, 0, 0)}, "what both have is there at once"
    assert set(completed(moved).tiles) == {(0, 0, 0), (-1, 0, 0)}


def test_checkpoints_come_and_go(tmp_path: Path) -> None:
    first = write_checkpoint(tmp_path, 1, EMPTY)
    history = History(tmp_path)
    write_checkpoint(tmp_path, 2, EMPTY)
    assert epochs(history) == [1, 2]
    first.unlink()
    assert [moment(file) for file in history.files()] == ["epoch 2, 2026-01-31T14:00:00Z"]
    assert history.damaged() == []


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1000])


@pytest.mark.parametrize("damage", [rot, cut])
def test_damaged_checkpoints_are_named_and_left_out(
    tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    write_checkpoint(tmp_path, 1, EMPTY)
    damage(write_checkpoint(tmp_path, 2, EMPTY))
    history = History(tmp_path)
    assert history.newest().queries.epoch == 1
    assert epochs(history) == [1]
    (problem,) = history.damaged()
    assert problem.startswith("epoch-000000002.triquad is left out: ")


def test_a_moment_that_cannot_be_shown_is_none_any_more(tmp_path: Path) -> None:
    write_checkpoint(tmp_path, 1, EMPTY)
    rot(write_checkpoint(tmp_path, 2, EMPTY))
    write_checkpoint(tmp_path, 3, EMPTY)
    history = History(tmp_path)
    assert history.newest().queries.epoch == 3
    with pytest.raises(DamagedError, match="epoch-000000002"):
        history.opened(history.files()[1])
    assert epochs(history) == [1, 3]


def test_a_store_of_which_nothing_is_left(tmp_path: Path) -> None:
    rot(write_checkpoint(tmp_path, 1, EMPTY))
    with pytest.raises(DamagedMapFileError, match="no checkpoint can be shown"):
        History(tmp_path).newest()
