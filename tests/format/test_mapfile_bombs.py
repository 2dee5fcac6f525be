"""Small files that unpack to much: they are refused before they take the memory."""

import dataclasses
import struct
import tracemalloc
import zlib

import msgpack
import numpy as np
import pytest
import zstandard
from mcap.writer import IndexType
from support.map_records import SMALL, random_record, with_outcomes, with_rays
from support.mapfile_edit import (
    RawPart,
    edited,
    file_bytes,
    in_level,
    listed,
    manifest_of,
    metadata_of,
    parts_of,
    read_bytes,
    rebuild,
    set_array,
    stored,
    stored_record,
    with_manifest,
)
from triquad_format.errors import DamagedMapFileError, MapFileError
from triquad_format.mapfile.manifest import FileRef
from triquad_format.mapfile.mcap.records import MAX_CHUNK_BYTES
from triquad_format.mapfile.parts.part import EVIDENCE, REGION, VERTICES, PartKey
from triquad_format.records.region import MapRecord

DATA = file_bytes(random_record(12))


def chunk_file(declared, stored_bytes, compression=b"zstd"):
    """An MCAP file with one chunk that declares any size."""
    chunk = struct.pack("<QQQI", 0, 0, declared, 0)
    chunk += struct.pack("<I", len(compression)) + compression
    chunk += struct.pack("<Q", len(stored_bytes)) + stored_bytes
    data = rebuild([], metadata_of(file_bytes(MapRecord("default", 0, SMALL, ()))))
    header_end = 8 + 9 + struct.unpack_from("<Q", data, 9)[0]
    metadata_end = header_end + 9 + struct.unpack_from("<Q", data, header_end + 1)[0]
    body = data[:metadata_end] + struct.pack("<BQ", 6, len(chunk)) + chunk
    end = struct.pack("<BQI", 0x0F, 4, zlib.crc32(body))
    return body + end + struct.pack("<BQQQI", 0x02, 20, 0, 0, 0) + data[:8]


def test_bombs_are_not_allocated():
    bomb = zstandard.compress(bytes(50 * 2**20))
    for declared in (MAX_CHUNK_BYTES + 1, 2**63, 10):
        with pytest.raises(MapFileError, match="limit|declares|contradicts"):
            read_bytes(chunk_file(declared, bomb))
    streamed = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(50 * 2**20))
    with pytest.raises(DamagedMapFileError):
        read_bytes(chunk_file(1000, streamed))
    with pytest.raises(DamagedMapFileError):
        read_bytes(chunk_file(1000, b"no zstd"))
    with pytest.raises(MapFileError):
        read_bytes(chunk_file(10 * 2**20, zstandard.compress(bytes(10 * 2**20)) + b"more"))


def test_what_follows_a_frame_is_refused_before_the_frame_is_decompressed():
    """Four bytes at the end are a checksum only where the frame's head says so."""
    content = np.random.default_rng(0).bytes(10 * 2**20)
    mutant = chunk_file(len(content), zstandard.compress(content) + b"more")
    tracemalloc.start()
    with pytest.raises(DamagedMapFileError, match="does not end with its zstd frame"):
        read_bytes(mutant)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < len(mutant) + len(content)


def bomb_of(payload):
    """A file with this payload as the head of its region."""
    parts = parts_of(DATA)
    hostile = listed([parts[0], RawPart(REGION, payload), *parts[2:-1]], manifest_of(DATA))
    return rebuild(hostile, metadata_of(DATA), index_types=IndexType.CHUNK)


def bomb_of_parts(count):
    """A file with so many empty parts, which its manifest does not list."""
    parts = parts_of(DATA)
    longer = [*parts[:-1], *[RawPart("/triquad/x", b"")] * count, parts[-1]]
    options = {"chunk_size": 30 << 20, "index_types": IndexType.CHUNK}
    return rebuild(longer, metadata_of(DATA), **options)


def bomb_of_codes(count):
    """A file whose first square announces so many codes, each of which takes eight bytes."""
    codes = set_array("codes", np.ones((1, count), np.uint8))
    return edited(DATA, VERTICES, in_level(0, codes))


def bomb_of_evidence(field, shape):
    """A file whose evidence announces so many levels, times or outcomes."""
    column = set_array(field, np.ones(shape, np.uint8))
    return edited(file_bytes(with_outcomes(random_record(12))), EVIDENCE, column)


def bomb_of_rays():
    """A file in which a few leaves hold so many rays."""
    counts = set_array("counts", np.full((5, 1), 255, np.uint8))
    return edited(file_bytes(with_rays(random_record(12))), "/triquad/rays", counts)


BOMBS = {
    "rays": bomb_of_rays,
    "lists": lambda: bomb_of(msgpack.packb([[[[[]] * 60] * 60] * 60] * 60)),
    "texts": lambda: bomb_of(msgpack.packb([[["ab"] * 60] * 60] * 60)),
    "zeros": lambda: bomb_of(bytes(11 * 2**20)),
    "codes": lambda: bomb_of_codes(11 * 2**20),
    "levels": lambda: bomb_of_evidence("levels", (3, 3 * 2**20)),
    "times": lambda: bomb_of_evidence("seen_s", (1, 11 * 2**20)),
    "outcomes": lambda: bomb_of_evidence("outcomes", (10, 2**20)),
    "parts": lambda: bomb_of_parts(2**18),
}


@pytest.mark.parametrize("name", BOMBS)
@pytest.mark.parametrize("read", [read_bytes, stored_record])
def test_small_files_take_little_memory(name, read):
    mutant = BOMBS[name]()
    assert len(mutant) < 2**18
    tracemalloc.start()
    with pytest.raises(MapFileError):
        read(mutant)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 64 * 2**20 + len(mutant)


def test_a_manifest_lists_no_more_than_the_file_has_room_for():
    def longer(manifest):
        file = FileRef("other.triquad", bytes(32))
        entry = dataclasses.replace(manifest.own[1], sha256=bytes(32), file=file)
        more = tuple(
            dataclasses.replace(entry, key=PartKey("/triquad/x", (0, 0, 0), 0, cell))
            for cell in range(50_000)
        )
        return dataclasses.replace(manifest, entries=(*manifest.entries, *more))

    mutant = with_manifest(DATA, longer)
    assert len(mutant) < 50_000 * 32
    for read in (read_bytes, stored):
        with pytest.raises(DamagedMapFileError, match="too long"):
            read(mutant)
