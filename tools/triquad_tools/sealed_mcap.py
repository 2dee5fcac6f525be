"""MCAP files put together around spoilt records, with right checksums and a right index.

So what reads them meets the spoilt record itself, and not a checksum before it.
"""

import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import zstandard
from triquad_format.mapfile.mcap.records import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    HEADER,
    MAGIC,
    MESSAGE,
    METADATA,
    METADATA_INDEX,
    McapFile,
    walk,
)

_EVERYTHING = 1 << 40

Edit = Callable[[bytes], bytes]


@dataclass(frozen=True)
class Piece:
    """A record: what it is, and its content."""

    opcode: int
    content: bytes


@dataclass(frozen=True)
class LooseMessage:
    """A message on its own."""

    topic: str
    encoding: str
    payload: bytes


@dataclass(frozen=True)
class Dissected:
    """A map file in pieces."""

    pieces: tuple[Piece, ...]  # of its data section
    messages: tuple[LooseMessage, ...]


def dissect(data: bytes) -> Dissected:
    """A sound file in pieces."""
    pieces = []
    for record in walk(memoryview(data), len(MAGIC)):
        if record.opcode == DATA_END:
            break
        pieces.append(Piece(record.opcode, bytes(record.content)))
    found = McapFile(memoryview(data)).messages(_EVERYTHING)
    messages = tuple(LooseMessage(each.topic, each.encoding, each.data) for each in found)
    return Dissected(tuple(pieces), messages)


def packed(piece: Piece) -> bytes:
    """A record with its head."""
    return struct.pack("<BQ", piece.opcode, len(piece.content)) + piece.content


def sealed(pieces: Sequence[Piece], edit_summary: Edit = bytes) -> bytes:
    """A file of these records; its summary passes through ``edit_summary`` before its checksum."""
    out = bytearray(MAGIC)
    summary = bytearray()
    for piece in pieces:
        start = len(out)
        out += packed(piece)
        indexed = _index_of(piece, start, len(out) - start)
        if indexed is not None:
            summary += packed(indexed)
    out += packed(Piece(DATA_END, struct.pack("<I", zlib.crc32(out))))
    footer = struct.pack("<BQQQ", FOOTER, 20, len(out), 0)
    edited = edit_summary(bytes(summary))
    return bytes(out + edited + footer + struct.pack("<I", zlib.crc32(edited + footer)) + MAGIC)


def _index_of(piece: Piece, start: int, length: int) -> Piece | None:
    if piece.opcode == CHANNEL:
        return piece
    if piece.opcode == CHUNK:
        index = struct.pack("<QQQQIQ", 0, 0, start, length, 0, 0) + _text(b"") + bytes(16)
        return Piece(CHUNK_INDEX, index)
    if piece.opcode == METADATA:
        size = int.from_bytes(piece.content[:4], "little")
        name = _text(piece.content[4 : 4 + size])
        return Piece(METADATA_INDEX, struct.pack("<QQ", start, length) + name)
    return None


def rebuilt(
    pieces: Sequence[Piece], messages: Sequence[LooseMessage], compressed: bool = False
) -> bytes:
    """A file with header and metadata of ``pieces``, and a chunk for each message."""
    channels: dict[str, Piece] = {}
    chunks = []
    for each in messages:
        number = list(channels).index(each.topic) if each.topic in channels else len(channels)
        content = struct.pack("<HH", number, 0) + _text(each.topic.encode())
        channels[each.topic] = Piece(CHANNEL, content + _text(each.encoding.encode()) + bytes(4))
        message = Piece(MESSAGE, struct.pack("<HIQQ", number, 0, 0, 0) + each.payload)
        chunks.append(chunk(packed(message), compressed))
    kept = [piece for piece in pieces if piece.opcode in (HEADER, METADATA)]
    return sealed([*kept, *channels.values(), *chunks])


def chunk(records: bytes, compressed: bool, declared: int | None = None) -> Piece:
    """A chunk of these records; it may declare another size."""
    size = len(records) if declared is None else declared
    stored = zstandard.compress(records, 1) if compressed else records
    name = _text(b"zstd" if compressed else b"")
    head = struct.pack("<QQQI", 0, 0, size, zlib.crc32(records)) + name
    return Piece(CHUNK, head + struct.pack("<Q", len(stored)) + stored)


def chunk_records(piece: Piece) -> bytes:
    """The records in a sound chunk."""
    size = int.from_bytes(piece.content[28:32], "little")
    stored = piece.content[32 + size + 8 :]
    return zstandard.decompress(stored) if size else stored


def _text(data: bytes) -> bytes:
    return struct.pack("<I", len(data)) + data
