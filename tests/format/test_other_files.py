"""Parts by random access, in one file and in the files that a delta names."""

import dataclasses
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from support.file_damage import first_chunk, flipped
from support.map_records import assert_same, random_record, with_integers
from support.mapfile_edit import (
    file_bytes,
    manifest_of,
    parts_of,
    read_bytes,
    rewritten,
    write_pair,
    write_record,
)
from triquad_format.errors import DamagedMapFileError, MapFileError
from triquad_format.mapfile.index import MapIndex, MemoryBytes
from triquad_format.mapfile.parts.part import VERTICES
from triquad_format.mapfile.reader import read_map
from triquad_format.records.map_progress import MapProgress
from triquad_format.records.region import MapRecord
from triquad_format.recovery.recovered_map import recover
from triquad_map.stored_map import StoredMap

BASE = random_record(30, indices=((0, 0, 0), (1, 0, 0)), epoch=3)
CHANGED = with_integers(random_record(31, indices=((0, 0, 0), (1, 0, 0)), epoch=4))
NEXT = dataclasses.replace(
    BASE,
    epoch=4,
    regions=(BASE.regions[0], CHANGED.regions[1]),
    progress=MapProgress(61, 117_000_000, 0.2),
)


@pytest.fixture
def pair(tmp_path: Path) -> Path:
    """A folder with ``base.triquad`` and ``next.triquad``, whose first region is the base's."""
    write_pair(tmp_path, BASE, NEXT)
    return tmp_path


def both_readers(path: Path) -> Iterator[Callable[[], MapRecord]]:
    """The record by each way of reading."""
    yield lambda: read_map(path)

    def by_index() -> MapRecord:
        with StoredMap.open(path) as map_file:
            return map_file.record()

    yield by_index


def test_each_part_is_found() -> None:
    data = file_bytes(BASE)
    index = MapIndex(MemoryBytes(data))
    payloads = [index.payload(entry) for entry in index.manifest.entries]
    assert payloads == [part.payload for part in parts_of(data)[:-1]]


def test_a_delta_and_its_base_are_one_map(pair: Path) -> None:
    for read in both_readers(pair / "next.triquad"):
        assert_same(read(), NEXT)
    assert_same(read_map(pair / "base.triquad"), BASE)
    assert (pair / "next.triquad").stat().st_size < 0.7 * (pair / "base.triquad").stat().st_size


def test_a_delta_of_a_delta_names_each_file_that_it_needs(pair: Path) -> None:
    known = manifest_of((pair / "next.triquad").read_bytes()).elsewhere("next.triquad")
    record = dataclasses.replace(NEXT, epoch=9)
    written = write_record(pair / "third.triquad", record, known=known)
    assert set(written.manifest.files) == {"base.triquad", "next.triquad"}
    assert len(written.manifest.own) == 1
    for read in both_readers(pair / "third.triquad"):
        assert_same(read(), record)


def test_a_delta_needs_its_folder(pair: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    with pytest.raises(MapFileError, match=r"base.triquad.*cannot be reached"):
        read_bytes((pair / "next.triquad").read_bytes())
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    shutil.copy(pair / "next.triquad", elsewhere)
    for read in both_readers(elsewhere / "next.triquad"):
        with pytest.raises(DamagedMapFileError, match=r"base.triquad, .*, is missing"):
            read()


DAMAGED_BASES: dict[str, Callable[[bytes], bytes]] = {
    "cut": lambda data: data[: len(data) // 4],
    "empty": lambda data: b"",
    "another map": lambda data: file_bytes(random_record(32)),
    "no map": lambda data: b"not a map file",
    "rewritten by another program": lambda data: rewritten(data[:]),
    "a part altered": lambda data: flipped(data, first_chunk(data, VERTICES).middle),
}


@pytest.mark.parametrize("case", DAMAGED_BASES)
def test_a_base_that_is_not_the_one_is_refused(pair: Path, case: str) -> None:
    base = pair / "base.triquad"
    data = base.read_bytes()
    base.write_bytes(DAMAGED_BASES[case](data))
    before = os.listdir("/proc/self/fd")
    for read in both_readers(pair / "next.triquad"):
        with pytest.raises(DamagedMapFileError, match=r"next.triquad.*base.triquad"):
            read()
    assert os.listdir("/proc/self/fd") == before, "a file stays open after a refusal"
    base.write_bytes(data)
    for read in both_readers(pair / "next.triquad"):
        assert_same(read(), NEXT)


def test_a_base_that_is_a_folder_is_refused(pair: Path) -> None:
    (pair / "base.triquad").unlink()
    (pair / "base.triquad").mkdir()
    for read in both_readers(pair / "next.triquad"):
        with pytest.raises(DamagedMapFileError, match=r"base.triquad is not a regular file"):
            read()


def test_a_pipe_keeps_no_reader_waiting(tmp_path: Path) -> None:
    pipe = tmp_path / "map.triquad"
    os.mkfifo(pipe)
    for read in (read_map, StoredMap.open, recover):
        with pytest.raises(MapFileError, match="is not a regular file"):
            read(pipe)
