"""Small map files that unpack to much: they are refused before they take the memory."""

import dataclasses
import struct
import tracemalloc
from collections.abc import Callable

import msgpack
import numpy as np
import pytest
import zstandard
from support.files.mapfile_edit import (
    Edit,
    edited,
    file_bytes,
    first_level,
    read_bytes,
    rewritten,
    set_array,
    stored_record,
)
from support.maps.map_records import random_record, with_rays, with_support
from triquad_format.errors import DamagedMapFileError, MapFileError, UnsupportedMapFileError
from triquad_format.mapfile.container import chunk_messages
from triquad_format.mapfile.manifest import Manifest
from triquad_format.mapfile.parts.part import EVIDENCE, RAYS, VERTICES, PartKey
from triquad_format.records.region import MapRecord

RECORD = with_rays(with_support(random_record(12)))
DATA = file_bytes(RECORD)


def many_entries(manifest: Manifest) -> Manifest:
    """More parts than the file has room to list."""
    entry = dataclasses.replace(manifest.entries[1], sha256=bytes(32))
    more = tuple(
        dataclasses.replace(entry, key=PartKey("/triquad/x", (0, 0, 0), 0, cell))
        for cell in range(50_000)
    )
    return dataclasses.replace(manifest, entries=(*manifest.entries, *more))


def one_place(manifest: Manifest) -> Manifest:
    """All parts of this size at one place."""
    own = [dataclasses.replace(entry, size=30 * 2**20) for entry in manifest.entries]
    return dataclasses.replace(manifest, entries=tuple(own))


def bomb(payload: bytes) -> Callable[[], bytes]:
    """A file with this payload as the head of its region."""
    return lambda: rewritten(DATA, payloads={1: payload})


def column_bomb(topic: str, edit: Edit) -> Callable[[], bytes]:
    return lambda: edited(DATA, topic, edit)


def ones(key: str, *shape: int) -> Edit:
    return set_array(key, np.ones(shape, np.uint8))


BOMBS: dict[str, Callable[[], bytes]] = {
    "rays": column_bomb(RAYS, set_array("counts", np.full((5, 1), 255, np.uint8))),
    "lists": bomb(msgpack.packb([[[[[]] * 60] * 60] * 60] * 60)),
    "zeros": bomb(bytes(30 * 2**20)),
    "a manifest of zeros": lambda: rewritten(DATA, manifest_payload=lambda _: bytes(30 * 2**20)),
    "codes": column_bomb(VERTICES, first_level(ones("codes", 1, 11 * 2**20))),
    "outcomes": column_bomb(EVIDENCE, ones("outcomes", 10, 2**20)),
    "parts": lambda: rewritten(DATA, manifest=many_entries),
    "sizes": lambda: rewritten(DATA, manifest=one_place),
}


@pytest.mark.parametrize("case", BOMBS)
@pytest.mark.parametrize("read", [read_bytes, stored_record])
def test_small_files_take_little_memory(case: str, read: Callable[[bytes], MapRecord]) -> None:
    mutant = BOMBS[case]()
    assert len(mutant) < 2**18
    tracemalloc.start()
    with pytest.raises(MapFileError):
        read(mutant)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 64 * 2**20 + len(mutant)


FRAME = zstandard.compress(bytes(50 * 2**20))
STREAMED = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(50 * 2**20))


@pytest.mark.parametrize(
    ("size", "stored_bytes", "message"),
    [
        (2**63, FRAME, "declares"),
        (50 * 2**20, FRAME, "declares"),
        (10, FRAME, "contradicts"),
        (1000, STREAMED, "cannot be read"),
        (1000, b"no zstd", "cannot be read"),
    ],
)
def test_chunks_that_declare_too_much(size: int, stored_bytes: bytes, message: str) -> None:
    head = struct.pack("<QQQII4sQ", 0, 0, size, 0, 4, b"zstd", len(stored_bytes))
    record = struct.pack("<BQ", 6, len(head) + len(stored_bytes)) + head + stored_bytes
    tracemalloc.start()
    with pytest.raises(DamagedMapFileError, match=message):
        chunk_messages(record, 0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


def test_other_compression_is_told() -> None:
    head = struct.pack("<QQQII3sQ", 0, 0, 9, 0, 3, b"lz4", 9) + bytes(9)
    with pytest.raises(UnsupportedMapFileError, match="lz4"):
        chunk_messages(struct.pack("<BQ", 6, len(head)) + head, 0)
