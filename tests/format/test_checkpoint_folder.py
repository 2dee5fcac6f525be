"""A folder of checkpoints: which there are, and the one of an epoch or a time."""

from pathlib import Path

import pytest
from support.map_records import random_record
from support.mapfile_edit import write_record
from triquad_format.errors import DamagedMapFileError, MapFileError
from triquad_format.mapfile.checkpoint_folder import (
    CheckpointFile,
    checkpoint_at,
    checkpoint_file,
    checkpoint_files,
    checkpoint_name,
    map_folder,
    newest_of_each,
    open_manifest,
)
from triquad_format.mapfile.reader import read_map

NOON_NS = 1_767_268_800 * 10**9  # 2026-01-01T12:00:00Z
HOUR_NS = 3600 * 10**9


def write_checkpoint(
    folder: Path, epoch: int, complete: bool = True, hours: int | None = 0
) -> Path:
    """A checkpoint of so many hours after noon; ``None``: its writer was not given the time."""
    path = folder / checkpoint_name(epoch, complete)
    stamp_ns = None if hours is None else NOON_NS + hours * HOUR_NS
    write_record(path, random_record(1, points=3, epoch=epoch), stamp_ns=stamp_ns)
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Epochs 3, 5 and 8, an hour between them; 5 is there twice; and what is no checkpoint."""
    folder = tmp_path / "default"
    folder.mkdir()
    for epoch, complete, hours in ((3, True, 0), (5, False, 1), (5, True, 1), (8, False, 2)):
        write_checkpoint(folder, epoch, complete, hours)
    for other in (".epoch-000000009.triquad.1a2b3c4d.tmp", "epoch-9.triquad", "notes.txt"):
        (folder / other).write_bytes(b"")
    return folder


def test_names() -> None:
    assert checkpoint_name(7, True) == "epoch-000000007.triquad"
    assert checkpoint_name(7, False) == "epoch-000000007.delta.triquad"
    for epoch in (0, 7, 10**9, 2**63 - 1):
        for complete in (True, False):
            path = Path("maps") / checkpoint_name(epoch, complete)
            assert checkpoint_file(path) == CheckpointFile(epoch, complete, path)
    for other in ("epoch-7.triquad", "epoch-000000007.triquad.tmp", "epoch-00000000٧.triquad"):
        assert checkpoint_file(Path(other)) is None


def test_listing_is_newest_first(folder: Path) -> None:
    files = checkpoint_files(folder)
    assert [(f.epoch, f.complete) for f in files] == [(8, False), (5, True), (5, False), (3, True)]
    assert [(f.epoch, f.complete) for f in newest_of_each(files)] == [
        (8, False),
        (5, True),
        (3, True),
    ]


@pytest.mark.parametrize(("when", "epoch"), [("3", 3), ("4", 3), ("5", 5), ("7", 5), ("8", 8)])
def test_by_epoch(folder: Path, when: str, epoch: int) -> None:
    file = checkpoint_at(folder, when)
    assert file.epoch == epoch
    assert file.complete == (epoch != 8)
    assert read_map(file.path).epoch == epoch


@pytest.mark.parametrize(
    ("when", "epoch"),
    [
        ("2026-01-01T12:00:00Z", 3),
        ("2026-01-01T12:59:59Z", 3),
        ("2026-01-01T13:00:00+00:00", 5),
        ("2026-01-01T15:00:00+02:00", 5),
        ("2026-01-01T13:59:59.999999Z", 5),
        ("2030-01-01T00:00:00Z", 8),
    ],
)
def test_by_time(folder: Path, when: str, epoch: int) -> None:
    assert checkpoint_at(folder, when).epoch == epoch


@pytest.mark.parametrize("when", ["2", "2026-01-01T11:59:59Z"])
def test_before_the_first(folder: Path, when: str) -> None:
    with pytest.raises(MapFileError, match=r"no checkpoint of .* or before, but epochs 3 to 8"):
        checkpoint_at(folder, when)


@pytest.mark.parametrize("when", ["9", "1795277535"])
def test_a_number_after_the_newest_may_be_meant_as_a_time(folder: Path, when: str) -> None:
    with pytest.raises(MapFileError, match=f"epochs 3 to 8, not {when}; a time is written as"):
        checkpoint_at(folder, when)


@pytest.mark.parametrize("when", ["yesterday", "-1", "2026-13-01T00:00:00Z", ""])
def test_neither_epoch_nor_time(folder: Path, when: str) -> None:
    with pytest.raises(MapFileError, match="neither"):
        checkpoint_at(folder, when)


def test_an_empty_folder(tmp_path: Path) -> None:
    assert checkpoint_files(tmp_path) == []
    with pytest.raises(MapFileError, match="or before, but nothing"):
        checkpoint_at(tmp_path, "5")


def test_by_time_damaged_and_unstamped_files_are_passed_over(folder: Path) -> None:
    (folder / checkpoint_name(8, False)).write_bytes(b"damaged")
    assert checkpoint_at(folder, "2030-01-01T00:00:00Z").epoch == 5
    write_checkpoint(folder, 42, hours=None)
    assert checkpoint_at(folder, "2030-01-01T00:00:00Z").epoch == 5
    assert checkpoint_at(folder, "42").epoch == 42


def test_open_manifest(folder: Path) -> None:
    manifest = open_manifest(checkpoint_at(folder, "5"))
    assert manifest.facts.epoch == 5
    assert manifest.stamp_ns == NOON_NS + HOUR_NS
    broken = folder / checkpoint_name(3, True)
    broken.write_bytes(broken.read_bytes()[:-50])
    with pytest.raises(DamagedMapFileError, match=broken.name):
        open_manifest(checkpoint_at(folder, "3"))


def test_map_folder(folder: Path) -> None:
    assert map_folder(folder) == folder
    assert map_folder(folder.parent) == folder
    with pytest.raises(MapFileError, match="maps in it: none"):
        map_folder(make(folder / "deeper"))


def test_a_store_of_several_maps(folder: Path) -> None:
    second = make(folder.parent / "second")
    assert map_folder(folder.parent) == folder
    write_checkpoint(second, 1)
    with pytest.raises(MapFileError, match="maps in it: default, second"):
        map_folder(folder.parent)


def make(folder: Path) -> Path:
    folder.mkdir()
    return folder
