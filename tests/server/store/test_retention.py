"""Which checkpoints stay, and for how long they are protected."""

import json
from collections.abc import Sequence
from pathlib import Path

import pytest
from triquad_format.mapfile.protections import (
    PROTECTIONS_NAME,
    Protection,
    Protections,
    read_protections,
    write_protections,
)
from triquad_server.settings import StoreSettings
from triquad_server.store.protected_checkpoints import Clocks, ProtectedCheckpoints
from triquad_server.store.retention import KeptCheckpoint, needed_files

HOUR_S = 3600
DAY_H = 24.0


def checkpoints(*needs: str) -> list[KeptCheckpoint]:
    """One for each text, the newest first; its words are the names of its files."""
    epochs = range(len(needs), 0, -1)
    return [
        KeptCheckpoint(epoch, 0, frozenset(files.split()))
        for epoch, files in zip(epochs, needs, strict=True)
    ]


def staying(kept: Sequence[KeptCheckpoint], protected: set[int], **settings: int) -> str:
    sizes = dict.fromkeys("abcdef", 10)
    chosen = StoreSettings(**settings)
    needed = needed_files(kept, sizes, chosen, protected=protected, now_ns=10**9)
    return "".join(sorted(needed))


def test_a_protected_checkpoint_stays_with_the_files_that_it_needs() -> None:
    kept = checkpoints("f", "e", "d a", "c b", "b", "a")
    assert staying(kept, set(), keep=2) == "ef"
    assert staying(kept, {3}, keep=2) == "bcef"
    assert staying(kept, {3, 4}, keep=2) == "abcdef"


def test_protected_checkpoints_do_not_count_against_the_limits_of_the_others() -> None:
    kept = checkpoints("f", "e", "d", "c", "b", "a")
    assert staying(kept, set(), keep=4, keep_bytes=30) == "def"
    assert staying(kept, {1, 2}, keep=4, keep_bytes=30) == "abdef"


class SetClocks:
    """Two clocks that a test sets."""

    def __init__(self) -> None:
        self.monotonic_s = 5000.0
        self.wall_s = 1_700_000_000.0

    def pass_s(self, seconds: float) -> None:
        self.monotonic_s += seconds
        self.wall_s += seconds

    def restart(self, folder: Path) -> ProtectedCheckpoints:
        clocks = Clocks(lambda: self.monotonic_s, lambda: int(self.wall_s * 1e9))
        return ProtectedCheckpoints(folder, DAY_H, clocks)


def test_protection_lasts_its_time_over_restarts(tmp_path: Path) -> None:
    clocks = SetClocks()
    clocks.restart(tmp_path).add(7, "before a reset")
    clocks.pass_s(20 * HOUR_S)
    protected = clocks.restart(tmp_path)
    assert protected.epochs == {7}
    assert protected.first_ends_h == pytest.approx(4)
    clocks.pass_s(4 * HOUR_S + 1)
    assert protected.epochs == set()
    protected.renew([7])
    assert read_protections(tmp_path).checkpoints == ()


@pytest.mark.parametrize("jump_s", [1e9, -1e9])
def test_a_clock_that_jumps_while_the_server_runs_ends_nothing(
    tmp_path: Path, jump_s: float
) -> None:
    clocks = SetClocks()
    protected = clocks.restart(tmp_path)
    protected.add(7, "before a reset")
    clocks.wall_s += jump_s
    clocks.pass_s(HOUR_S)
    protected.renew([7])
    assert protected.epochs == {7}
    again = clocks.restart(tmp_path)  # the list was made anew since, by the clock that jumped
    assert again.epochs == {7}
    assert again.first_ends_h == pytest.approx(23)


def test_a_clock_that_was_set_back_between_two_servers_makes_nothing_younger(
    tmp_path: Path,
) -> None:
    clocks = SetClocks()
    protected = clocks.restart(tmp_path)
    protected.add(7, "before a reset")
    clocks.pass_s(HOUR_S)
    protected.renew([7])
    clocks.wall_s = 0.0
    assert clocks.restart(tmp_path).first_ends_h == pytest.approx(23)


def test_what_is_gone_is_no_longer_listed(tmp_path: Path) -> None:
    protected = SetClocks().restart(tmp_path)
    for epoch in (7, 8):
        protected.add(epoch, "before a reset")
    protected.renew([8])
    assert [one.epoch for one in read_protections(tmp_path).checkpoints] == [8]


@pytest.mark.parametrize(
    "content",
    [
        b"", b"[]", b"{}", b'"x"', b"[" * 100_000, b"\xff", b" " * 2**21,
        b'{"version": 2, "listed_ns": 0, "checkpoints": []}',
        b'{"version": 1, "listed_ns": -1, "checkpoints": []}',
        b'{"version": 1, "listed_ns": 0, "checkpoints": [{"epoch": true, "age_s": 0, "why": ""}]}',
        b'{"version": 1, "listed_ns": 0, "checkpoints": [{"epoch": 1, "age_s": NaN, "why": ""}]}',
    ],
)  # fmt: skip
def test_where_the_list_is_damaged_every_checkpoint_is_protected(
    tmp_path: Path, content: bytes
) -> None:
    (tmp_path / PROTECTIONS_NAME).write_bytes(content)
    for name in ("epoch-000000003.triquad", "epoch-000000009.delta.triquad", "lock"):
        (tmp_path / name).touch()
    assert SetClocks().restart(tmp_path).epochs == {3, 9}
    assert (tmp_path / (PROTECTIONS_NAME + ".damaged")).read_bytes() == content


def test_the_list_is_written_as_the_specification_has_it(tmp_path: Path) -> None:
    write_protections(tmp_path, Protections(12, (Protection(412, 61.5, "before a reset"),)))
    wanted = (
        '{"version": 1, "listed_ns": 12, "checkpoints": '
        '[{"epoch": 412, "age_s": 61.5, "why": "before a reset"}]}'
    )
    assert json.loads((tmp_path / PROTECTIONS_NAME).read_bytes()) == json.loads(wanted)
