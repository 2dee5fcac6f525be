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

_HEADER, _FOOTER, _CHANNEL, _MESSAGE = 0x01, 0x02, 0x04, 0x05
_CHUNK, _METADATA, _DATA_END = 0x06, 0x0C, 0x0F
_RECORD = struct.Struct("<BQ")


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
            _metadata(record) for record in self._records if record.opcode == _METADATA
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
            if record.opcode == _CHUNK:
                chunk = _decompress(record, max_bytes)
                max_bytes -= len(chunk)
                ratio = len(record.content) / max(len(chunk), 1)
                for inner in _walk(chunk, 0):
                    yield from _message(inner, channels, ratio)
            else:
                yield from _message(record, channels, 1.0)


class _Fields:
    """Reads the fields of one record; never past its end."""

    def __init__(self, record: Record) -> None:
        self._record = record
        self._offset = 0

    def take(self, size: int) -> memoryview:
        end = self._offset + size
        if end > len(self._record.content):
            raise DamagedMapFileError(
                f"the record at byte {self._record.start} ends in the middle of a field",
            )
        self._offset, start = end, self._offset
        return self._record.content[start:end]

    def number(self, size: int) -> int:
        return int.from_bytes(self.take(size), "little")

    def text(self) -> str:
        raw = bytes(self.take(self.number(4)))
        try:
            return raw.decode()
        except UnicodeDecodeError as error:
            raise DamagedMapFileError(
                f"the record at byte {self._record.start} holds a text that is not UTF-8",
            ) from error

    def rest(self) -> memoryview:
        return self._record.content[self._offset :]

    @property
    def left(self) -> int:
        return len(self._record.content) - self._offset


def _walk(data: memoryview, offset: int) -> Iterator[Record]:
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
        if opcode == _FOOTER:
            return
        offset = record.end


def _data_section(data: memoryview) -> list[Record]:
    """The records between magic and DataEnd, once all the file's checksums are found right."""
    records: list[Record] = []
    walk = _walk(data, len(MAGIC))
    for record in walk:
        if record.opcode == _DATA_END:
            _check_crc("data section", data[: record.start], _Fields(record).number(4))
            _check_tail(data, record.end, walk)
            return records
        if record.opcode == _FOOTER:
            break
        if (record.opcode == _HEADER) != (not records):
            raise DamagedMapFileError("its header record is missing or misplaced")
        records.append(record)
    raise DamagedMapFileError("it is incomplete: the record that ends the data is missing")


def _check_tail(data: memoryview, summary_start: int, walk: Iterator[Record]) -> None:
    """Check summary, footer and closing magic."""
    footer = None
    for footer in walk:
        if footer.opcode in (_HEADER, _MESSAGE, _CHUNK, _DATA_END):
            raise DamagedMapFileError(f"the summary holds a data record at byte {footer.start}")
    if footer is None or footer.opcode != _FOOTER:
        raise DamagedMapFileError("it is incomplete: its footer is missing")
    if data[footer.end :] != MAGIC:
        raise DamagedMapFileError("it does not end with its footer")
    fields = _Fields(footer)
    declared_start, _, crc = fields.number(8), fields.number(8), fields.number(4)
    if declared_start not in (0, summary_start):
        raise DamagedMapFileError(f"its footer names byte {declared_start} as the summary's start")
    _check_crc("summary", data[summary_start : footer.end - 4], crc)


def _check_crc(name: str, data: memoryview, declared: int) -> None:
    """Compare a checksum; writers that compute none declare 0."""
    if declared and zlib.crc32(data) != declared:
        raise DamagedMapFileError(f"the {name} at {len(data)} bytes fails its checksum")


def _metadata(record: Record) -> tuple[str, dict[str, str]]:
    fields = _Fields(record)
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


def _decompress(record: Record, max_bytes: int) -> memoryview:
    fields = _Fields(record)
    fields.take(16)  # times of the first and last message
    size, crc, compression = fields.number(8), fields.number(4), fields.text()
    stored = fields.take(fields.number(8))
    where = f"the chunk at byte {record.start}"
    if fields.left:
        raise DamagedMapFileError(f"{where} does not fill its record")
    if size > MAX_CHUNK_BYTES:
        raise DamagedMapFileError(f"{where} declares {size} bytes; the limit is {MAX_CHUNK_BYTES}")
    if size > max_bytes:
        raise TooLargeMapFileError(f"{where} takes the map over the limit given for its size")
    if compression == "":
        chunk = stored
    elif compression == "zstd":
        chunk = _decompress_zstd(where, stored, size)
    else:
        raise UnsupportedMapFileError(f"{where} is compressed with {compression!r}; use zstd")
    if len(chunk) != size:
        raise DamagedMapFileError(f"{where} holds {len(chunk)} bytes, but declares {size}")
    _check_crc(where, chunk, crc)
    return chunk


def _decompress_zstd(where: str, stored: memoryview, size: int) -> memoryview:
    """At most ``size`` bytes: the size in the zstd frame is compared before it is allocated."""
    try:
        if zstandard.frame_content_size(stored) not in (-1, size):
            raise DamagedMapFileError(f"{where} contradicts the size in its zstd frame")
        decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES)
        return memoryview(
            decompressor.decompress(stored, max_output_size=size, allow_extra_data=False)
        )
    except zstandard.ZstdError as error:
        raise DamagedMapFileError(f"{where} cannot be decompressed: {error}") from error


def _message(
    record: Record, channels: dict[int, tuple[str, str]], ratio: float
) -> Iterator[Message]:
    """The message in a record, if it is one; a channel is noted in ``channels``.

    ``ratio`` is that of stored to decompressed bytes.
    """
    fields = _Fields(record)
    if record.opcode == _CHANNEL:
        number = fields.number(2)
        fields.take(2)  # schema
        channel = (fields.text(), fields.text())
        if channels.setdefault(number, channel) != channel:
            raise DamagedMapFileError(f"channel {number} is both {channels[number]} and {channel}")
    elif record.opcode == _MESSAGE:
        number = fields.number(2)
        fields.take(20)  # sequence, log time, publish time
        if number not in channels:
            raise DamagedMapFileError(f"a message is of channel {number}, which nothing describes")
        stored = round(len(record.content) * ratio)
        yield Message(*channels[number], bytes(fields.rest()), stored)
