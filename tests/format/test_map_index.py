"""Parts by random access, in one file and in the files that a delta names."""

import dataclasses
import io
import os
import shutil

import pytest
from mcap.writer import CompressionType, IndexType, Writer
from support.file_damage import flipped
from support.map_records import assert_same, random_record, with_integers
from support.mapfile_edit import (
    MemoryBytes,
    file_bytes,
    metadata_of,
    parts_of,
    read_bytes,
    rebuild,
    write_pair,
    write_record,
)
from triquad_format.errors import DamagedMapFileError, MapFileError, NoIndexError
from triquad_format.mapfile.index import FileBytes, MapIndex
from triquad_format.mapfile.manifest import FileRef
from triquad_format.mapfile.reader import read_map
from triquad_format.recovery.recovered_map import recover
from triquad_map.stored_map import StoredMap

BASE = random_record(30, indices=((0, 0, 0), (1, 0, 0)), epoch=3)
NEXT = with_integers(random_record(31, indices=((0, 0, 0), (1, 0, 0)), epoch=4))


@pytest.fixture
def pair(tmp_path):
    """A folder with ``base.triquad`` and ``next.triquad``, whose first region is the base's."""
    write_pair(tmp_path, BASE, next_record())
    return tmp_path


def next_record():
    return dataclasses.replace(BASE, epoch=4, regions=(BASE.regions[0], NEXT.regions[1]))


def both_readers(path):
    """The record by each way of reading."""
    yield lambda: read_map(path)

    def by_index():
        with StoredMap.open(path) as map_file:
            return map_file.record()

    yield by_index


def test_each_part_is_found():
    data = file_bytes(BASE)
    index = MapIndex(MemoryBytes(data))
    payloads = [index.payload(entry) for entry in index.manifest.entries]
    assert payloads == [part.payload for part in parts_of(data)[:-1]]


def test_a_delta_and_its_base_are_one_map(pair):
    for read in both_readers(pair / "next.triquad"):
        assert_same(read(), next_record())
    assert (pair / "next.triquad").stat().st_size < 0.7 * (pair / "base.triquad").stat().st_size


def test_a_delta_of_a_delta_names_each_file_that_it_needs(pair):
    with StoredMap.open(pair / "next.triquad") as map_file:
        manifest = map_file.manifest
    index = MapIndex(FileBytes(pair / "next.triquad"))
    here = FileRef("next.triquad", index.manifest_sha256)
    index.close()
    known = {e.key: dataclasses.replace(e, file=e.file or here) for e in manifest.entries}
    record = dataclasses.replace(next_record(), epoch=9)
    written = write_record(pair / "third.triquad", record, known=known)
    assert {file.name for file in written.manifest.files} == {"base.triquad", "next.triquad"}
    assert len(written.manifest.own) == 1
    for read in both_readers(pair / "third.triquad"):
        assert_same(read(), record)


def test_a_delta_needs_its_folder(pair, tmp_path_factory):
    with pytest.raises(MapFileError, match=r"base.triquad.*cannot be reached"):
        read_bytes((pair / "next.triquad").read_bytes())
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    shutil.copy(pair / "next.triquad", elsewhere)
    for read in both_readers(elsewhere / "next.triquad"):
        with pytest.raises(DamagedMapFileError, match=r"base.triquad, .*, is missing"):
            read()


def replace_base(folder, data):
    (folder / "base.triquad").write_bytes(data)


DAMAGED_BASES = {
    "cut": lambda data: data[: len(data) // 2],
    "empty": lambda data: b"",
    "another map": lambda data: file_bytes(random_record(32)),
    "the same map, later": lambda data: file_bytes(BASE, stamp_ns=1),
    "no map": lambda data: b"not a map file",
    "rewritten by another tool": lambda data: rebuild(
        parts_of(data), metadata_of(data), chunk_size=1 << 20
    ),
    "a part altered": lambda data: flipped(data, len(data) // 3),
}


@pytest.mark.parametrize("case", DAMAGED_BASES)
def test_a_base_that_is_not_the_one_is_refused(pair, case):
    base = (pair / "base.triquad").read_bytes()
    replace_base(pair, DAMAGED_BASES[case](base))
    for read in both_readers(pair / "next.triquad"):
        with pytest.raises(DamagedMapFileError, match=r"next.triquad.*base.triquad"):
            read()
    replace_base(pair, base)
    for read in both_readers(pair / "next.triquad"):
        assert_same(read(), next_record())


def test_a_base_that_is_a_folder_is_refused(pair):
    (pair / "base.triquad").unlink()
    (pair / "base.triquad").mkdir()
    for read in both_readers(pair / "next.triquad"):
        with pytest.raises(DamagedMapFileError, match=r"base.triquad is not a regular file"):
            read()


def test_no_file_stays_open_after_a_refusal(pair):
    replace_base(pair, file_bytes(random_record(32)))
    before = os.listdir("/proc/self/fd")
    for read in both_readers(pair / "next.triquad"):
        with pytest.raises(DamagedMapFileError):
            read()
    assert os.listdir("/proc/self/fd") == before


@pytest.mark.parametrize(
    "options",
    [
        {"chunk_size": 1 << 20},
        {"use_chunking": False},
        {"index_types": IndexType.NONE},
        {"index_types": IndexType.CHUNK},
        {"index_types": IndexType.METADATA},
        {"enable_crcs": False},
    ],
)
def test_files_rewritten_by_another_tool_are_read_as_a_whole(tmp_path, options):
    data = file_bytes(BASE, preview=True)
    path = tmp_path / "rewritten.triquad"
    path.write_bytes(rebuild(parts_of(data), metadata_of(data), **options))
    assert_same(read_map(path), BASE)
    with pytest.raises(NoIndexError, match="rewritten.triquad"):
        StoredMap.open(path)


def test_files_rewritten_part_by_part_keep_their_index(tmp_path):
    data = file_bytes(BASE, preview=True)
    path = tmp_path / "rewritten.triquad"
    path.write_bytes(rebuild(parts_of(data), metadata_of(data), compression=CompressionType.NONE))
    for read in both_readers(path):
        assert_same(read(), BASE)


def test_a_pipe_keeps_no_reader_waiting(tmp_path):
    pipe = tmp_path / "map.triquad"
    os.mkfifo(pipe)
    for read in (read_map, StoredMap.open, recover):
        with pytest.raises(MapFileError, match="is not a regular file"):
            read(pipe)


def test_metadata_that_is_indexed_twice_is_refused():
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    for _ in range(2):
        writer.add_metadata("triquad", metadata_of(file_bytes(BASE))["triquad"])
    writer.finish()
    with pytest.raises(DamagedMapFileError, match="more than once"):
        StoredMap(MemoryBytes(stream.getvalue()))
