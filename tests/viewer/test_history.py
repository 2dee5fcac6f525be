"""Maps that stay open, tiles that are made, and checkpoints that come and go."""

from collections.abc import Callable
from pathlib import Path

import pytest
from support.files.changing_store import EMPTY, write_checkpoint
from triquad_tools.viewer.sources.history import DamagedError, History


def test_checkpoints_come_and_go(tmp_path: Path) -> None:
    first = write_checkpoint(tmp_path, 1, EMPTY)
    history = History(tmp_path)
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
    tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    write_checkpoint(tmp_path, 1, EMPTY)
    damage(write_checkpoint(tmp_path, 2, EMPTY))
    history = History(tmp_path)
    assert history.newest().queries.epoch == 1
    assert [moment.epoch for moment in history.moments] == [1]
    (problem,) = history.damaged
    assert problem.startswith("epoch-000000002.triquad is left out: ")


def test_a_moment_that_cannot_be_shown_is_none_any_more(tmp_path: Path) -> None:
    write_checkpoint(tmp_path, 1, EMPTY)
    flip(write_checkpoint(tmp_path, 2, EMPTY))
    write_checkpoint(tmp_path, 3, EMPTY)
    history = History(tmp_path)
    assert history.newest().queries.epoch == 3
    with pytest.raises(DamagedError, match="epoch-000000002"):
        history.opened(history.moments[1])
    assert [moment.epoch for moment in history.moments] == [1, 3]
