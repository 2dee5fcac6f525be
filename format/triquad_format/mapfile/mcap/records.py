"""The records of MCAP files, read no further than there are bytes.

The size of a chunk is bounded before it is decompressed.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import zstandard

from triquad_format.errors import DamagedMapFileError, UnsupportedMapFileError

MAGIC = b"\x89MCAP0\r\n"

HEADER, FOOTER, CHANNEL, MESSAGE = 0x01, 0x02, 0x04, 0x05
CHUNK, CHUNK_INDEX, METADATA, METADATA_INDEX, DATA_END = 0x06, 0x08, 0x0C, 0x0D, 0x0F
_RECORD = struct.Struct("<BQ")

FOOTER_BYTES = _RECORD.size + 20

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
_OUT_OF_MEMORY = "not enough memory"


@dataclass(frozen=True)
class Record:
    """One record as it lies in the file."""

    opcode: int
    start: int  # of its opcode, bytes from the beginning of the file or chunk
    content: memoryview

    @property
    def end(self) -> int:
        """Where the next record begins."""
        return self.start + _RECORD.size + len(self.content)


class Channel(NamedTuple):
    """What all messages of one channel share."""

    topic: str
    encoding: str


@dataclass(frozen=True)
class Message:
    """One message, and its channel."""

    channel: Channel
    data: bytes
    stored_bytes: int  # its share of the record in the file that holds it, compressed


class Fields:
    """Reads the fields of one record; past its end it raises :class:`DamagedMapFileError`."""

    def __init__(self, record: Record) -> None:
        self._record = record
        self._offset = 0

    def take(self, size: int) -> memoryview:
        """The next ``size`` bytes."""
        end = self._offset + size
        if end > len(self._record.content):
            raise DamagedMapFileError(
                f"the record at byte {self._record.start} ends in the middle of a field",
            )
        self._offset, start = end, self._offset
        return self._record.content[start:end]

    def number(self, size: int) -> int:
        """The next field, a number of ``size`` bytes."""
        return int.from_bytes(self.take(size), "little")

    def text(self) -> str:
        """The next field, a string."""
        raw = bytes(self.take(self.number(4)))
        try:
            return raw.decode()
        except UnicodeDecodeError as error:
            raise DamagedMapFileError(
                f"the record at byte {self._record.start} holds a text that is not UTF-8",
            ) from error

    @property
    def left(self) -> int:
        """Bytes that follow."""
        return len(self._record.content) - self._offset


def walk(data: memoryview, offset: int) -> Iterator[Record]:
    """Records from ``offset`` on; those of a file end with its footer.

    Raises:
        DamagedMapFileError: one of them does not fit into ``data``.
    """
    while offset < len(data):
        if len(data) - offset < _RECORD.size:
            raise DamagedMapFileError(f"it ends in the middle of a record, at byte {len(data)}")
        opcode, length = _RECORD.unpack_from(data, offset)
        start = offset + _RECORD.size
        if opcode == 0 or length > len(data) - start:
            raise DamagedMapFileError(
                f"the record at byte {offset} (opcode {opcode}) of {length} bytes does not fit "
                f"the {len(data)} bytes there are: it is incomplete",
            )
        record = Record(opcode, offset, data[start : start + length])
        yield record
        if opcode == FOOTER:
            return
        offset = record.end


def check_crc(name: str, data: memoryview | bytes, declared: int) -> None:
    """Raise :class:`DamagedMapFileError` unless the CRC-32 of ``data`` is the declared one.

    Writers that compute none declare 0.
    """
    if declared and zlib.crc32(data) != declared:
        raise DamagedMapFileError(f"{name} fails its checksum")


def metadata_entries(record: Record) -> tuple[str, dict[str, str]]:
    """Name and entries of a metadata record.

    Raises:
        DamagedMapFileError: it is malformed, or has a key twice.
    """
    fields = Fields(record)
    name, length = fields.text(), fields.number(4)
    if length != fields.left:
        raise DamagedMapFileError(f"the metadata at byte {record.start} does not fill its record")
    entries: dict[str, str] = {}
    while fields.left:
        key = fields.text()
        if key in entries:
            raise DamagedMapFileError(f"the metadata {name!r} holds {key!r} twice")
        entries[key] = fields.text()
    return name, entries


def channel_entry(record: Record) -> tuple[int, Channel]:
    """Number and description in a record of the opcode ``CHANNEL``.

    Raises:
        DamagedMapFileError: it is malformed.
    """
    fields = Fields(record)
    number = fields.number(2)
    fields.take(2)  # schema
    return number, Channel(fields.text(), fields.text())


def record_messages(
    record: Record, channels: dict[int, Channel], stored_share: float = 1.0
) -> Iterator[Message]:
    """The message in a record, if it is one; if it describes a channel, ``channels`` gets it.

    Args:
        record: of any opcode, not compressed.
        channels: those known so far, by number.
        stored_share: stored bytes for each byte of the record.

    Raises:
        DamagedMapFileError: the record is malformed or contradicts ``channels``.
    """
    if record.opcode == CHANNEL:
        number, channel = channel_entry(record)
        if channels.setdefault(number, channel) != channel:
            raise DamagedMapFileError(
                f"channel {number} is both {tuple(channels[number])} and {tuple(channel)}"
            )
    elif record.opcode == MESSAGE:
        fields = Fields(record)
        number = fields.number(2)
        fields.take(20)  # sequence, log time, publish time
        if number not in channels:
            raise DamagedMapFileError(f"a message is of channel {number}, which nothing describes")
        stored = round(len(record.content) * stored_share)
        yield Message(channels[number], bytes(fields.take(fields.left)), stored)


@dataclass(frozen=True)
class Chunk:
    """A chunk as it lies in the file; nothing is decompressed before its messages are read."""

    record: Record
    size: int  # bytes of its records, as it says
    crc: int  # of its records; 0 where its writer computed none
    compression: str
    stored: memoryview

    def messages(self, channels: dict[int, Channel]) -> Iterator[Message]:
        """Its messages; ``channels`` gets those that are described in it.

        Raises:
            MapFileError: the chunk or a message is malformed, too large or fails its checksum.
        """
        data = self._decompressed()
        stored_share = len(self.record.content) / max(len(data), 1)
        for inner in walk(data, 0):
            yield from record_messages(inner, channels, stored_share)

    def _decompressed(self) -> memoryview:
        where, size, stored = f"the chunk at byte {self.record.start}", self.size, self.stored
        if size > MAX_CHUNK_BYTES:
            raise DamagedMapFileError(
                f"{where} declares {size} bytes; the limit is {MAX_CHUNK_BYTES}"
            )
        if size > chunk_limit(len(stored)):
            raise DamagedMapFileError(f"{where} declares {size} bytes, but stores {len(stored)}")
        if self.compression not in ("", "zstd"):
            raise UnsupportedMapFileError(
                f"{where} is compressed with {self.compression!r}; use zstd"
            )
        data = _decompress_zstd(where, stored, size) if self.compression else stored
        if len(data) != size:
            raise DamagedMapFileError(f"{where} holds {len(data)} bytes, but declares {size}")
        check_crc(where, data, self.crc)
        return data


def read_chunk(record: Record) -> Chunk:
    """The chunk in a record of the opcode ``CHUNK``.

    Raises:
        DamagedMapFileError: its fields do not fill the record.
    """
    fields = Fields(record)
    fields.take(16)  # times of the first and last message
    size, crc, compression = fields.number(8), fields.number(4), fields.text()
    stored = fields.take(fields.number(8))
    if fields.left:
        raise DamagedMapFileError(f"the chunk at byte {record.start} does not fill its record")
    return Chunk(record, size, crc, compression=compression, stored=stored)


def chunk_limit(stored_size: int) -> int:
    """Bytes to which a chunk of ``stored_size`` bytes may decompress."""
    return max(FREE_CHUNK_BYTES, MAX_CHUNK_RATIO * stored_size)


def total_limit(file_size: int) -> int:
    """Bytes to which all chunks of a file may decompress together."""
    return _FREE_TOTAL_BYTES + _MAX_TOTAL_RATIO * file_size


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
        if _OUT_OF_MEMORY in str(error):  # zstd's, for buffers of its own: no damage
            raise MemoryError(f"{where} cannot be decompressed") from error
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
