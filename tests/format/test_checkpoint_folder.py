"""A folder of checkpoints: which there are, and the one of an epoch or a time."""

import hashlib
import os
from pathlib import Path

import msgpack
import pytest
import zstandard
from support.files.checkpoint_folder import write_record
from support.files.file_damage import flipped
from support.maps.map_records import random_record
from triquad_format.errors import DamagedMapFileError, MapFileError, UnsupportedMapFileError
from triquad_format.mapfile.checkpoint_folder import (
    CheckpointFile,
    checkpoint_file,
    checkpoint_files,
    checkpoint_name,
    map_folder,
)
from triquad_format.mapfile.index import MAGIC, read_checkpoint
from triquad_format.mapfile.reader import StoredMap, open_manifest, read_map
from triquad_format.mapfile.writer import write_map
from triquad_tools.mapfiles.recovery import recover
from triquad_tools.mapfiles.source import checkpoint_at

NOON_NS = 1_767_268_800 * 10**9  # 2026-01-01T12:00:00Z
HOUR_NS = 3600 * 10**9


def write_checkpoint(folder: Path, epoch: int, hours: int | None = 0) -> Path:
    """A checkpoint of so many hours after noon; ``None``: its writer was not given the time."""
    stamp_ns = 0 if hours is None else NOON_NS + hours * HOUR_NS
    return write_record(folder, random_record(1, points=3, epoch=epoch), stamp_ns)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Epochs 3, 5 and 8, an hour between them, the second as a map file; and other files."""
    folder = tmp_path / "default"
    folder.mkdir()
    write_checkpoint(folder, 3)
    backup = folder / "epoch-000000005.triquad"
    write_map(random_record(1, points=3, epoch=5), backup, stamp_ns=NOON_NS + HOUR_NS)
    write_checkpoint(folder, 8, hours=2)
    for other in (".epoch-000000009.checkpoint.1a2b3c4d.tmp", "epoch-9.checkpoint", "notes.txt"):
        (folder / other).write_bytes(b"")
    return folder


def test_names() -> None:
    assert checkpoint_name(7) == "epoch-000000007.checkpoint"
    for epoch in (0, 7, 10**9, 2**63 - 1):
        path = Path("maps") / checkpoint_name(epoch)
        assert checkpoint_file(path) == CheckpointFile(epoch, path)
    for other in ("epoch-7.triquad", "epoch-000000007.triquad.tmp", "epoch-00000000٧.triquad"):
        assert checkpoint_file(Path(other)) is None


def test_listing_is_newest_first(folder: Path) -> None:
    assert [file.epoch for file in checkpoint_files(folder)] == [8, 5, 3]


@pytest.mark.parametrize(("when", "epoch"), [("3", 3), ("4", 3), ("5", 5), ("7", 5), ("8", 8)])
def test_by_epoch(folder: Path, when: str, epoch: int) -> None:
    file = checkpoint_at(folder, when)
    assert file.epoch == epoch
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


def test_by_time_damaged_and_unstamped_files_are_passed_over(folder: Path) -> None:
    (folder / checkpoint_name(8)).write_bytes(b"damaged")
    assert checkpoint_at(folder, "2030-01-01T00:00:00Z").epoch == 5
    write_checkpoint(folder, 42, hours=None)
    assert checkpoint_at(folder, "2030-01-01T00:00:00Z").epoch == 5
    assert checkpoint_at(folder, "42").epoch == 42


def test_map_folder(folder: Path) -> None:
    assert map_folder(folder) == folder
    assert map_folder(folder.parent) == folder
    for empty in (folder / "deeper", folder.parent / "second"):
        empty.mkdir()
    with pytest.raises(MapFileError, match="maps in it: none"):
        map_folder(folder / "deeper")
    assert map_folder(folder.parent) == folder
    write_checkpoint(folder.parent / "second", 1)
    with pytest.raises(MapFileError, match="maps in it: default, second"):
        map_folder(folder.parent)


# What a checkpoint's file may hold


def test_a_checkpoint_that_is_cut_or_damaged_is_refused(folder: Path) -> None:
    path = folder / checkpoint_name(8)
    data = path.read_bytes()
    cut = [data[:end] for end in (0, 10, 30, 60, 500, -1)]
    for harmed in (*cut, *(flipped(data, at) for at in range(0, len(data), 7))):
        path.write_bytes(harmed)
        with pytest.raises(MapFileError, match=path.name):
            open_manifest(CheckpointFile(8, path))


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        ({"min_reader_version": 3}, UnsupportedMapFileError, "version 3"),
        ({"undoes": 5}, DamagedMapFileError, "undoes"),
        ({"restored": [1, 2]}, DamagedMapFileError, "restored"),
        ({"restored": {"epoch": -1, "as_epoch": 2}}, DamagedMapFileError, "epoch = -1"),
        ({"parts": {}}, DamagedMapFileError, "topic"),
        ({"topics": []}, DamagedMapFileError, "topic"),
    ],
)
def test_hostile_values_are_refused(
    folder: Path, changes: dict[str, object], error: type[MapFileError], text: str
) -> None:
    path = folder / checkpoint_name(8)
    body = msgpack.unpackb(zstandard.decompress(path.read_bytes()[51:]))
    frame = zstandard.compress(msgpack.packb({**body, **changes}))
    path.write_bytes(MAGIC + hashlib.sha256(frame).digest() + frame)
    with pytest.raises(error, match=text):
        read_checkpoint(path)


def test_a_part_that_unpacks_to_more_than_is_listed_is_refused(folder: Path) -> None:
    path = folder / checkpoint_name(8)
    entry = open_manifest(CheckpointFile(8, path)).entries[0]
    bomb = zstandard.compress(bytes(30 * 2**20))
    (folder / "parts" / entry.name).write_bytes(bomb + bytes(max(entry.stored - len(bomb), 0)))
    with pytest.raises(DamagedMapFileError, match=f"parts/{entry.name}"):
        read_map(path)


def test_a_pipe_keeps_no_reader_waiting(tmp_path: Path) -> None:
    pipe = tmp_path / "map.triquad"
    os.mkfifo(pipe)
    for read in (read_map, StoredMap.open, recover):
        with pytest.raises(MapFileError, match="is not a regular file"):
            read(pipe)
