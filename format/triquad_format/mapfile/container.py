"""The MCAP file around a map's parts, as the ``mcap`` library parses it.

A part is found by its place: a chunk record of one message, whose data is one zstd frame. Sizes
are checked before memory is allocated for them.
"""

import contextlib
import io
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, TypeVar

import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Chunk,
    DataEnd,
    Footer,
    McapRecord,
    Message,
    Metadata,
    MetadataIndex,
    SummaryOffset,
)
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC

from triquad_format.errors import DamagedMapFileError, MapFileError, UnsupportedMapFileError
from triquad_format.mapfile.parts.part import MAX_PART_BYTES

METADATA_NAME = "triquad"

MAX_STORED_BYTES = MAX_PART_BYTES + 65_536
"""Bytes of the largest chunk record: a part that does not shrink, and what is around it."""

_FREE_CHUNK_BYTES = 12 * 2**20
_MAX_CHUNK_RATIO = 2
"""A chunk above ``_FREE_CHUNK_BYTES`` may decompress to this multiple of its stored size: parts in
it are compressed already."""

_MAX_SUMMARY_BYTES = 64 * 2**20
_MAX_METADATA_BYTES = 2**20
_BLOCK_BYTES = 8192
"""Content of a zstd block: maps are 4 % smaller with it than with blocks as large as may be."""

_MAX_WINDOW_BYTES = 8 * 2**20
"""Memory that zstd may ask for besides its output; RFC 8878 has every decoder support it."""

_DATA_END_BYTES = 9 + 4
_BEGIN = MCAP0_MAGIC + b"\x01\x0f" + bytes(11) + b"\x07\0\0\0triquad"
"""The header of each map file, which names no profile; recordings of triquad name one."""

_NO_MAP = "this is an MCAP file, but not a map: of a recording, triquad-map makes one"

_END_BYTES = 9 + 20 + len(MCAP0_MAGIC)  # of the footer and the closing magic
_OUT_OF_MEMORY = "not enough memory"

_RecordT = TypeVar("_RecordT", bound=McapRecord)


class RandomAccess(Protocol):
    """The source of a file's bytes."""

    name: str
    size: int  # bytes

    def read(self, offset: int, length: int) -> bytes:
        """Return exactly ``length`` bytes from ``offset`` on.

        Raises:
            DamagedMapFileError: there are fewer.
            OSError: they cannot be read.
        """

    def close(self) -> None:
        """Close the source."""


def is_map(source: RandomAccess) -> bool:
    """Return whether a source begins as the map files of triquad; it may be damaged, or empty."""
    begin = source.read(0, min(len(_BEGIN), source.size))
    return begin == _BEGIN[: len(begin)]


@dataclass(frozen=True)
class FileEnd:
    """The summary at the end of a map file."""

    metadata: dict[str, str]  # of the record "triquad"
    data_bytes: int  # of the file before its record DataEnd
    data_crc: int  # of these


def read_end(source: RandomAccess) -> FileEnd:
    """Read the summary of a file, check it, and read the metadata that it points to.

    Raises:
        MapFileError: it is not a map file.
        DamagedMapFileError: its end is missing or damaged.
    """
    size = source.size
    start = source.read(0, min(len(MCAP0_MAGIC), size))
    if start != MCAP0_MAGIC[: len(start)]:
        raise MapFileError("this is not a map file: it does not begin as MCAP files do")
    if size < len(MCAP0_MAGIC) + _DATA_END_BYTES + _END_BYTES:
        raise DamagedMapFileError(f"it is incomplete: {size} bytes")
    end = source.read(size - _END_BYTES, _END_BYTES)
    if not end.endswith(MCAP0_MAGIC):
        raise DamagedMapFileError("it is incomplete: its end is missing")
    footer = _first(end, Footer, "the footer")
    data_bytes = footer.summary_start - _DATA_END_BYTES
    if not 0 <= size - data_bytes <= _MAX_SUMMARY_BYTES:
        raise DamagedMapFileError(f"its footer names byte {footer.summary_start} as the summary's")
    tail = source.read(data_bytes, size - data_bytes)
    if zlib.crc32(tail[_DATA_END_BYTES : -4 - len(MCAP0_MAGIC)]) != footer.summary_crc:
        if not is_map(source):  # other writers may leave the checksum out
            raise MapFileError(_NO_MAP)
        raise DamagedMapFileError("the summary fails its checksum")
    data_end = _first(tail, DataEnd, "the end of the data")
    place = _metadata_place(tail, data_bytes, footer)
    if place.length > _MAX_METADATA_BYTES:
        raise DamagedMapFileError(f"the metadata at byte {place.offset} is too long")
    record = _first(source.read(place.offset, place.length), Metadata, "the metadata")
    return FileEnd(record.metadata, data_bytes, data_end.data_section_crc)


def _metadata_place(tail: bytes, start: int, footer: Footer) -> MetadataIndex:
    """Return where the metadata ``triquad`` lies, by the summary in ``tail`` from ``start`` on."""
    offsets = _records(tail[max(footer.summary_offset_start - start, 0) :], "the summary offsets")
    places: list[MetadataIndex] = []
    for offset in offsets:
        if isinstance(offset, SummaryOffset) and offset.group_opcode == Opcode.METADATA_INDEX:
            group = _records(tail[max(offset.group_start - start, 0) :], "the index of metadata")
            places += [r for r in group if isinstance(r, MetadataIndex) and r.name == METADATA_NAME]
    if not places:
        raise MapFileError(_NO_MAP)
    if len(places) > 1:
        raise DamagedMapFileError("the metadata 'triquad' is there more than once")
    return places[0]


def read_message(source: RandomAccess, offset: int, stored: int) -> bytes:
    """Return the data of the message in the chunk record at a place.

    Raises:
        DamagedMapFileError: there is no intact chunk of one message.
    """
    if stored > MAX_STORED_BYTES:
        raise DamagedMapFileError(f"{stored} bytes at byte {offset} are no part: it is too long")
    messages = chunk_messages(source.read(offset, stored), offset)
    if len(messages) != 1:
        raise DamagedMapFileError(f"the chunk at byte {offset} holds {len(messages)} messages")
    return messages[0]


def chunk_messages(data: bytes, where: int) -> list[bytes]:
    """Return the data of the messages in the chunk record with which ``data`` begins.

    ``where`` is its place in the file, for messages.

    Raises:
        UnsupportedMapFileError: it is compressed otherwise than with zstd.
        DamagedMapFileError: it is no chunk, declares too much, or fails its checksum.
    """
    name = f"the chunk at byte {where}"
    chunk = _first(data, Chunk, name)
    size, stored = chunk.uncompressed_size, chunk.data
    if chunk.compression not in ("", "zstd"):
        raise UnsupportedMapFileError(f"{name} is compressed with {chunk.compression!r}; use zstd")
    if size > max(_FREE_CHUNK_BYTES, _MAX_CHUNK_RATIO * len(stored)):
        raise DamagedMapFileError(f"{name} declares {size} bytes, but stores {len(stored)}")
    with _parsing(name):
        if chunk.compression and zstandard.frame_content_size(stored) not in (-1, size):
            raise DamagedMapFileError(f"{name} contradicts the size in its zstd frame")
        records = breakup_chunk(chunk, validate_crc=True)
    return [record.data for record in records if isinstance(record, Message)]


def compress(data: bytes, level: int) -> bytes:
    """Return one zstd frame of small blocks.

    A block has one Huffman table: noise and numbers in one block compress badly.

    Raises:
        MemoryError: zstd needs memory of its own, and nothing else can fail.
    """
    with _parsing("what is to be compressed"):
        compressor = zstandard.ZstdCompressor(level=level).compressobj(size=len(data))
        pieces: list[bytes] = []
        for first in range(0, len(data), _BLOCK_BYTES):
            pieces.append(compressor.compress(data[first : first + _BLOCK_BYTES]))
            pieces.append(compressor.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK))
        return b"".join([*pieces, compressor.flush()])


def decompress(frame: bytes, limit: int = MAX_PART_BYTES) -> bytes:
    """Return the content of a zstd frame, which states its size: at most ``limit`` bytes.

    Raises:
        DamagedMapFileError: it is no whole frame, or is larger.
    """
    with _parsing("a part"):
        size = zstandard.frame_content_size(frame)
        if not 0 <= size <= limit:
            raise DamagedMapFileError(f"a part of {size} bytes, where {limit} are the limit")
        decompressor = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW_BYTES)
        return decompressor.decompress(frame, allow_extra_data=False)


def _first(data: bytes, kind: type[_RecordT], name: str) -> _RecordT:
    """Return the record with which ``data`` begins, which must be of a kind."""
    record = next(_parsed(data, name), None)
    if not isinstance(record, kind):
        raise DamagedMapFileError(f"{name} is missing or damaged: the file may be incomplete")
    return record


def _records(data: bytes, name: str) -> list[McapRecord]:
    """Return the records in ``data``, which ends with the footer and the closing magic."""
    return list(_parsed(data, name))


def _parsed(data: bytes, name: str) -> Iterator[McapRecord]:
    # A stream in memory gives no more than there is, whatever length is declared.
    stream = io.BytesIO(data)
    with _parsing(name):
        reader = StreamReader(stream, True, emit_chunks=True, record_size_limit=len(data))
        yield from reader.records


@contextlib.contextmanager
def _parsing(name: str) -> Iterator[None]:
    """Turn what the libraries raise into errors of this package.

    Raises:
        DamagedMapFileError: they cannot parse ``name``.
        MemoryError: zstd is out of memory.
    """
    try:
        yield
    except (McapError, zstandard.ZstdError, struct.error, ValueError, OverflowError) as error:
        if _OUT_OF_MEMORY in str(error):  # zstd's, for buffers of its own: no damage
            raise MemoryError(f"{name}: {error}") from error
        raise DamagedMapFileError(f"{name} cannot be read: {error or type(error)}") from error
