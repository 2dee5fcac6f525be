"""MCAP files of edited records, with right checksums and a right index.

What reads such a file meets the edited record itself, and not a checksum before it.
"""

import struct
import zlib
from collections.abc import Callable, Sequence
from typing import NamedTuple

import zstandard
from triquad_format.mapfile.mcap.records import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    MAGIC,
    METADATA,
    METADATA_INDEX,
    walk,
)


class RawRecord(NamedTuple):
    """A record of an MCAP file."""

    opcode: int
    content: bytes


def records_of(data: bytes) -> list[RawRecord]:
    """The records of a valid file's data section."""
    records = []
    for record in walk(memoryview(data), len(MAGIC)):
        if record.opcode == DATA_END:
            break
        records.append(RawRecord(record.opcode, bytes(record.content)))
    return records


def packed(record: RawRecord) -> bytes:
    """A record with its head."""
    return struct.pack("<BQ", record.opcode, len(record.content)) + record.content


def checksummed(
    records: Sequence[RawRecord], edit_summary: Callable[[bytes], bytes] = bytes
) -> bytes:
    """A file of these records; its summary is edited before its checksum is computed."""
    out = bytearray(MAGIC)
    summary = bytearray()
    for record in records:
        start = len(out)
        out += packed(record)
        summary += _indexed(record, start, len(out) - start)
    out += packed(RawRecord(DATA_END, struct.pack("<I", zlib.crc32(out))))
    footer = struct.pack("<BQQQ", FOOTER, 20, len(out), 0)
    edited = edit_summary(bytes(summary))
    return bytes(out + edited + footer + struct.pack("<I", zlib.crc32(edited + footer)) + MAGIC)


def _indexed(record: RawRecord, start: int, length: int) -> bytes:
    """What the summary holds of a record."""
    if record.opcode == CHANNEL:
        return packed(record)
    if record.opcode == CHUNK:
        index = struct.pack("<QQQQIQ", 0, 0, start, length, 0, 0) + _text(b"") + bytes(16)
        return packed(RawRecord(CHUNK_INDEX, index))
    if record.opcode == METADATA:
        size = int.from_bytes(record.content[:4], "little")
        name = _text(record.content[4 : 4 + size])
        return packed(RawRecord(METADATA_INDEX, struct.pack("<QQ", start, length) + name))
    return b""


def chunk(records: bytes, *, compressed: bool, declared: int | None = None) -> RawRecord:
    """A chunk of these records; it may declare another size."""
    size = len(records) if declared is None else declared
    stored = zstandard.compress(records, 1) if compressed else records
    name = _text(b"zstd" if compressed else b"")
    head = struct.pack("<QQQI", 0, 0, size, zlib.crc32(records)) + name
    return RawRecord(CHUNK, head + struct.pack("<Q", len(stored)) + stored)


def chunk_records(record: RawRecord) -> bytes:
    """The records in a valid chunk."""
    size = int.from_bytes(record.content[28:32], "little")
    stored = record.content[32 + size + 8 :]
    return zstandard.decompress(stored) if size else stored


def _text(data: bytes) -> bytes:
    return struct.pack("<I", len(data)) + data
