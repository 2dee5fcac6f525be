"""Damaged map files: each is read as it was, as another valid map, or refused by name.

What is recovered of each is a valid map, or nothing.

``TRIQUAD_FUZZ`` is the number of mutants of each kind. Given, others are drawn each time, and none
may take longer than 5 s; otherwise they are always the same. Linux only: memory is limited.
"""

import io
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from fuzz.mutants import DAMAGE, FORGERY, Mutation, cut, flip_bits
from fuzz.reading import in_its_place, read_in_every_way
from fuzz.valid_maps import ValidMap, valid_maps
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from support.files.file_damage import chunks, flipped, zeroed
from support.files.mapfile_edit import file_bytes, read_bytes, rewritten, stored, stored_record
from support.maps.map_records import assert_same, random_record
from triquad_client import open_map
from triquad_format.errors import (
    DamagedMapFileError,
    MapFileError,
    TooLargeMapFileError,
    UnsupportedMapFileError,
)
from triquad_format.mapfile.parts.pack import pack_part, pack_record
from triquad_format.mapfile.parts.part import PartKey
from triquad_format.mapfile.reader import read_map
from triquad_format.mapfile.writer import write_parts

CAMPAIGN = os.environ.get("TRIQUAD_FUZZ")
COUNT = int(CAMPAIGN or 20)

mutants = settings(
    max_examples=COUNT,
    derandomize=CAMPAIGN is None,
    deadline=5000 if CAMPAIGN else None,
    suppress_health_check=list(HealthCheck),
    report_multiple_bugs=False,
)


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> list[ValidMap]:
    return valid_maps(tmp_path_factory.mktemp("maps"))


@pytest.mark.parametrize("mutation", DAMAGE)
@mutants
@given(data=st.data())
def test_damage_is_found(maps: list[ValidMap], mutation: Mutation, data: st.DataObject) -> None:
    check_mutant(maps, mutation, data)


@pytest.mark.parametrize("mutation", FORGERY)
@mutants
@given(data=st.data())
def test_forged_maps_are_valid(
    maps: list[ValidMap], mutation: Mutation, data: st.DataObject
) -> None:
    check_mutant(maps, mutation, data, forged=True)


def check_mutant(
    maps: list[ValidMap], mutation: Mutation, data: st.DataObject, *, forged: bool = False
) -> None:
    """Change one file of a map, and check what each way of reading the map makes of it."""
    # Checkpoints and their parts are no MCAP files: of these, only bytes are damaged.
    valid, name = data.draw(
        st.sampled_from(
            [
                (valid, name)
                for valid in maps
                for name in sorted(valid.files)
                if mutation in (flip_bits, cut) or name.endswith(".triquad")
            ]
        )
    )
    with in_its_place(valid, name, mutation(data.draw, valid.files[name])):
        event(read_in_every_way(valid, forged=forged))


RECORD = random_record(6, indices=((0, 0, 0), (1, 0, 0)))
DATA = file_bytes(RECORD, preview=True)


@pytest.mark.parametrize("number", range(len(chunks(DATA))))
def test_a_damaged_part_is_refused_when_it_is_read(number: int) -> None:
    chunk = chunks(DATA)[number]
    for mutant in (flipped(DATA, chunk.middle), zeroed(DATA, chunk.start, chunk.end)):
        with pytest.raises(DamagedMapFileError):
            read_bytes(mutant)
        if chunk.topic == "/preview/mesh":
            assert_same(stored_record(mutant), RECORD)  # nothing there is read
            continue
        with pytest.raises(MapFileError):
            stored_record(mutant)


@pytest.mark.parametrize("read", [read_map, open_map])
def test_messages_name_file_fault_and_remedy(
    tmp_path: Path, read: Callable[[Path], object]
) -> None:
    path = tmp_path / "broken.triquad"
    path.write_bytes(DATA[:-100])
    with pytest.raises(DamagedMapFileError, match=r"broken.triquad .*incomplete.*older"):
        read(path)
    path.write_bytes(b"")
    with pytest.raises(DamagedMapFileError, match="incomplete: 0 bytes"):
        read(path)
    for other in (b"PK\x03\x04 a zip file", b"\x89PNG\r\n\x1a\n" * 10):
        path.write_bytes(other)
        with pytest.raises(MapFileError, match="not a map file"):
            read(path)
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "none.triquad")


@pytest.mark.parametrize("has_checksums", [True, False])
@pytest.mark.parametrize("names", [[], ["other"], ["triquad", "triquad"]])
def test_other_mcap_files(names: list[str], has_checksums: bool) -> None:
    stream = io.BytesIO()
    writer = Writer(stream, enable_data_crcs=has_checksums, enable_crcs=has_checksums)
    writer.start("ros2")
    for name in names:
        writer.add_metadata(name, {})
    writer.finish()
    message = "more than once" if len(names) > 1 and has_checksums else "not a map"
    for read in (read_bytes, stored):
        with pytest.raises(MapFileError, match=message):
            read(stream.getvalue())


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        ({"min_reader_version": "3"}, UnsupportedMapFileError, "version 3.*triquad 0.2.0"),
        ({"min_reader_version": None}, DamagedMapFileError, "min_reader_version"),
        ({"min_reader_version": "9" * 5000}, DamagedMapFileError, "min_reader_version"),
        ({"epoch": "8"}, DamagedMapFileError, "epoch"),
        ({"frame_id": "odom"}, DamagedMapFileError, "frame_id"),
        ({"map": "other"}, DamagedMapFileError, "map"),
        ({"units": "ft"}, DamagedMapFileError, "units"),
        ({"manifest": None}, DamagedMapFileError, "manifest"),
        ({"manifest": "8"}, DamagedMapFileError, "manifest"),
        ({"manifest": "8 100"}, DamagedMapFileError, "chunk at byte 8"),
        ({"manifest": f"8 {2**40}"}, DamagedMapFileError, "too long"),
    ],
)
def test_metadata_is_checked(
    changes: dict[str, str | None], error: type[MapFileError], text: str
) -> None:
    mutant = rewritten(file_bytes(random_record(9, epoch=7)), metadata=changes)
    for read in (read_bytes, stored):
        with pytest.raises(error, match=text):
            read(mutant)


def test_later_minor_versions_are_read() -> None:
    changes = {"format_version": "4", "colour": "green"}
    later = rewritten(file_bytes(random_record(9)), metadata=changes)
    assert_same(read_bytes(later), random_record(9))
    assert_same(stored_record(later), random_record(9))


def test_unknown_parts_are_skipped_but_checked() -> None:
    part = pack_part(PartKey("/triquad/colours"), {"anything": 1})
    parts = [part, *pack_record(RECORD, "<f2", {})]
    stream = io.BytesIO()
    write_parts(stream, RECORD.facts, parts)
    data = stream.getvalue()
    assert_same(read_bytes(data), RECORD)
    assert_same(stored_record(data), RECORD)
    other = rewritten(data, payloads={1: b"anything else"}, fitting=False)
    with pytest.raises(DamagedMapFileError, match="colours"):
        read_bytes(other)


def test_total_is_limited(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    data = file_bytes(random_record(14, points=300))
    path = tmp_path / "map.triquad"
    path.write_bytes(data)
    for limit in (len(data) + 100, len(data) - 1):
        monkeypatch.setattr("triquad_format.mapfile.manifest.MAX_MAP_BYTES", limit)
        with pytest.raises(TooLargeMapFileError, match="limit"):
            read_map(path)
    monkeypatch.setattr("triquad_format.mapfile.manifest.MAX_MAP_BYTES", 10 * len(data))
    assert read_map(path).regions


READ_WITH_LITTLE_MEMORY = """
import os
import resource
import sys
from pathlib import Path

from triquad_format.mapfile.reader import read_map

for room in range(0, 6 * 2**20, 3 * 2**16):
    if os.fork() == 0:
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + room, resource.RLIM_INFINITY))
        try:
            read_map(sys.argv[1])
            outcome = b"read"
        except BaseException as error:
            outcome = type(error).__name__.encode()
        os.write(1, outcome + b"\\n")
        os._exit(0)
    os.wait()
"""


def test_too_little_memory_is_no_damage(tmp_path: Path) -> None:
    path = tmp_path / "map.triquad"
    path.write_bytes(file_bytes(random_record(3, points=20000)))
    command = [sys.executable, "-c", READ_WITH_LITTLE_MEMORY, str(path)]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert set(told.split()) == {"read", "TooLargeMapFileError"}
