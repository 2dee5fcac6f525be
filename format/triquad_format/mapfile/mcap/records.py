"""The records of MCAP files: what each holds, read no further than there are bytes."""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from triquad_format.errors import DamagedMapFileError

MAGIC = b"\x89MCAP0\r\n"

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

    def rest(self) -> memoryview:
        """All that follows."""
        return self._record.content[self._offset :]

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
        yield Message(channels[number], bytes(fields.rest()), stored)
