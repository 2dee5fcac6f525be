"""A strict reader of MCAP files: every length is bounded and every checksum is checked.

It reads a file front to back and does not need the summary, whose checksum it verifies. The
specification is at https://mcap.dev/spec. Unknown records are skipped, as that page demands.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import zstandard

from triquad_format.errors import (
    DamagedMapFileError,
    MapFileError,
    TooLargeMapFileError,
    UnsupportedMapFileError,
)

MAGIC = b"\x89MCAP0\r\n"

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

HEADER, FOOTER, CHANNEL, MESSAGE = 0x01, 0x02, 0x04, 0x05
CHUNK, CHUNK_INDEX, METADATA, METADATA_INDEX, DATA_END = 0x06, 0x08, 0x0C, 0x0D, 0x0F
_RECORD = struct.Struct("<BQ")

FOOTER_BYTES = _RECORD.size + 20


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


@dataclass(frozen=True)
class Message:
    """One message with the facts of its channel."""

    topic: str
    encoding: str
    data: bytes
    stored_bytes: int  # its share of the record in the file that holds it, compressed


class McapFile:
    """The records of an MCAP file whose frame, checksums and metadata have been checked."""

    def __init__(self, data: memoryview) -> None:
        """Check the frame of ``data``, the bytes of a whole file.

        Raises:
            MapFileError: it is no MCAP file, is incomplete, or fails a checksum.
        """
        if len(data) == 0:
            raise DamagedMapFileError("the file is empty")
        if data[: len(MAGIC)] != MAGIC[: len(data)]:
            raise MapFileError("this is not a map file: it does not begin as MCAP files do")
        self._records = _data_section(data)
        self.metadata = [
            metadata_entries(record) for record in self._records if record.opcode == METADATA
        ]

    def messages(self, max_bytes: int) -> Iterator[Message]:
        """All messages in the order of the file, chunked or not.

        Args:
            max_bytes: limit on all decompressed chunks together.

        Raises:
            MapFileError: a chunk or message is malformed, too large or fails its checksum.
        """
        channels: dict[int, tuple[str, str]] = {}
        for record in self._records:
            if record.opcode == CHUNK:
                size = declared_size(record)
                if size > max_bytes:
                    raise TooLargeMapFileError(
                        f"the chunk at byte {record.start} takes the map over the limit given for "
                        "its size"
                    )
                max_bytes -= size
                yield from chunk_messages(record, channels)
            else:
                yield from _message(record, channels, 1.0)


class Fields:
    """Reads the fields of one record; never past its end."""

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

    def rest(self) -> memoryview:
        """All that follows."""
        return self._record.content[self._offset :]

    @property
    def left(self) -> int:
        """Bytes that follow."""
        return len(self._record.content) - self._offset


def walk(data: memoryview, offset: int) -> Iterator[Record]:
    """Records from ``offset`` on; those of a file end with its footer."""
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


def _data_section(data: memoryview) -> list[Record]:
    """The records between magic and DataEnd, once all the file's checksums are found right."""
    records: list[Record] = []
    following = walk(data, len(MAGIC))
    for record in following:
        if record.opcode == DATA_END:
            check_crc("the data section", data[: record.start], Fields(record).number(4))
            _check_tail(data, record.end, following)
            return records
        if record.opcode == FOOTER:
            break
        if (record.opcode == HEADER) != (not records):
            raise DamagedMapFileError("its header record is missing or misplaced")
        records.append(record)
    raise DamagedMapFileError("it is incomplete: the record that ends the data is missing")


def _check_tail(data: memoryview, summary_start: int, following: Iterator[Record]) -> None:
    """Check summary, footer and closing magic."""
    footer = None
    for footer in following:
        if footer.opcode in (HEADER, MESSAGE, CHUNK, DATA_END):
            raise DamagedMapFileError(f"the summary holds a data record at byte {footer.start}")
    if footer is None or footer.opcode != FOOTER:
        raise DamagedMapFileError("it is incomplete: its footer is missing")
    if data[footer.end :] != MAGIC:
        raise DamagedMapFileError("it does not end with its footer")
    fields = Fields(footer)
    declared_start, _, crc = fields.number(8), fields.number(8), fields.number(4)
    if declared_start not in (0, summary_start):
        raise DamagedMapFileError(f"its footer names byte {declared_start} as the summary's start")
    check_crc("the summary", data[summary_start : footer.end - 4], crc)


def check_crc(name: str, data: memoryview | bytes, declared: int) -> None:
    """Compare a checksum; writers that compute none declare 0."""
    if declared and zlib.crc32(data) != declared:
        raise DamagedMapFileError(f"{name} fails its checksum")


def metadata_entries(record: Record) -> tuple[str, dict[str, str]]:
    """Name and entries of a metadata record."""
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


def chunk_messages(record: Record, channels: dict[int, tuple[str, str]]) -> Iterator[Message]:
    """The messages of a chunk; channels in it are noted in ``channels``.

    Raises:
        MapFileError: the chunk or a message is malformed, too large or fails its checksum.
    """
    chunk = _decompress(record)
    ratio = len(record.content) / max(len(chunk), 1)
    for inner in walk(chunk, 0):
        yield from _message(inner, channels, ratio)


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


def _message(
    record: Record, channels: dict[int, tuple[str, str]], ratio: float
) -> Iterator[Message]:
    """The message in a record, if it is one; a channel is noted in ``channels``.

    ``ratio`` is that of stored to decompressed bytes.
    """
    fields = Fields(record)
    if record.opcode == CHANNEL:
        number = fields.number(2)
        fields.take(2)  # schema
        channel = (fields.text(), fields.text())
        if channels.setdefault(number, channel) != channel:
            raise DamagedMapFileError(f"channel {number} is both {channels[number]} and {channel}")
    elif record.opcode == MESSAGE:
        number = fields.number(2)
        fields.take(20)  # sequence, log time, publish time
        if number not in channels:
            raise DamagedMapFileError(f"a message is of channel {number}, which nothing describes")
        stored = round(len(record.content) * ratio)
        yield Message(*channels[number], bytes(fields.rest()), stored)
