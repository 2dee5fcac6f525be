"""The chunks of MCAP files: their size is bounded before they are decompressed."""

from collections.abc import Iterator

import zstandard

from triquad_format.errors import DamagedMapFileError, UnsupportedMapFileError
from triquad_format.mapfile.mcap.records import (
    Channel,
    Fields,
    Message,
    Record,
    check_crc,
    record_messages,
    walk,
)

MAX_CHUNK_BYTES = 256 * 2**20
"""Decompressed size of the largest chunk."""

FREE_CHUNK_BYTES = 12 * 2**20
MAX_CHUNK_RATIO = 16
"""A chunk above ``FREE_CHUNK_BYTES`` has at most so many times its compressed size."""

_FREE_TOTAL_BYTES = 32 * 2**20
_MAX_TOTAL_RATIO = 32
"""All chunks together, decompressed, have at most so many times the file's size, and that more."""

MAX_WINDOW_BYTES = 8 * 2**20
"""Memory that zstd may ask for beside its output; RFC 8878 has every decoder support it."""

_MAX_BLOCK_BYTES = 2**17  # of a zstd block, decompressed
_RLE_BLOCK, _COMPRESSED_BLOCK = 1, 2
_CHECKSUM_BYTES = 4


def chunk_limit(stored_size: int) -> int:
    """Bytes to which a chunk of ``stored_size`` bytes may decompress."""
    return max(FREE_CHUNK_BYTES, MAX_CHUNK_RATIO * stored_size)


def total_limit(file_size: int) -> int:
    """Bytes to which all chunks of a file may decompress together."""
    return _FREE_TOTAL_BYTES + _MAX_TOTAL_RATIO * file_size


def declared_size(record: Record) -> int:
    """Bytes of a chunk's records, as it says."""
    fields = Fields(record)
    fields.take(16)  # times of the first and last message
    return fields.number(8)


def chunk_crc(record: Record) -> int:
    """Checksum of a chunk's records; 0 where its writer computed none."""
    fields = Fields(record)
    fields.take(24)  # times of the first and last message, size
    return fields.number(4)


def chunk_messages(record: Record, channels: dict[int, Channel]) -> Iterator[Message]:
    """The messages of a chunk, which is decompressed; ``channels`` gets those described in it.

    Raises:
        MapFileError: the chunk or a message is malformed, too large or fails its checksum.
    """
    chunk = _decompress(record)
    stored_share = len(record.content) / max(len(chunk), 1)
    for inner in walk(chunk, 0):
        yield from record_messages(inner, channels, stored_share)


def _decompress(record: Record) -> memoryview:
    fields = Fields(record)
    fields.take(16)  # times of the first and last message
    size, crc, compression = fields.number(8), fields.number(4), fields.text()
    stored = fields.take(fields.number(8))
    where = f"the chunk at byte {record.start}"
    if fields.left:
        raise DamagedMapFileError(f"{where} does not fill its record")
    if size > MAX_CHUNK_BYTES:
        raise DamagedMapFileError(f"{where} declares {size} bytes; the limit is {MAX_CHUNK_BYTES}")
    if size > chunk_limit(len(stored)):
        raise DamagedMapFileError(f"{where} declares {size} bytes, but stores {len(stored)}")
    if compression == "":
        chunk = stored
    elif compression == "zstd":
        chunk = _decompress_zstd(where, stored, size)
    else:
        raise UnsupportedMapFileError(f"{where} is compressed with {compression!r}; use zstd")
    if len(chunk) != size:
        raise DamagedMapFileError(f"{where} holds {len(chunk)} bytes, but declares {size}")
    check_crc(where, chunk, crc)
    return chunk


def _decompress_zstd(where: str, stored: memoryview, size: int) -> memoryview:
    """At most ``size`` bytes: the blocks are counted before memory is taken for them."""
    try:
        if zstandard.frame_content_size(stored) not in (-1, size):
            raise DamagedMapFileError(f"{where} contradicts the size in its zstd frame")
        if _most_decompressed(where, stored) < size:
            raise DamagedMapFileError(f"{where} declares {size} bytes, but is shorter")
        decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES)
        return memoryview(
            decompressor.decompress(stored, max_output_size=size, allow_extra_data=False)
        )
    except zstandard.ZstdError as error:
        raise DamagedMapFileError(f"{where} cannot be decompressed: {error}") from error


def _most_decompressed(where: str, stored: memoryview) -> int:
    """How many bytes the blocks of a zstd frame can give at most (RFC 8878, section 3.1.1.2)."""
    at = zstandard.frame_header_size(stored)
    most, last = 0, False
    while not last:
        header = int.from_bytes(stored[at : at + 3], "little")
        if at + 3 > len(stored):
            raise DamagedMapFileError(f"{where} ends within its zstd frame")
        last, kind, length = bool(header & 1), header >> 1 & 3, header >> 3
        if kind > _COMPRESSED_BLOCK:
            raise DamagedMapFileError(f"{where} holds a zstd block of an unknown kind")
        most += _MAX_BLOCK_BYTES if kind == _COMPRESSED_BLOCK else length
        at += 3 + (1 if kind == _RLE_BLOCK else length)
    if zstandard.get_frame_parameters(stored).has_checksum:
        at += _CHECKSUM_BYTES
    if at != len(stored):
        raise DamagedMapFileError(f"{where} does not end with its zstd frame")
    return most
