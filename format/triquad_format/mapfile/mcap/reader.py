"""MCAP files read front to back, or message by message by their index.

Read whole, every checksum is checked; the summary is not needed, but its checksum is checked where
there is one. Unknown records are skipped, as the specification demands.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from triquad_format.errors import (
    DamagedMapFileError,
    MapFileError,
    NoIndexError,
    TooLargeMapFileError,
)
from triquad_format.mapfile.mcap.records import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    FOOTER_BYTES,
    HEADER,
    MAGIC,
    MESSAGE,
    METADATA,
    METADATA_INDEX,
    Channel,
    Fields,
    Message,
    Record,
    channel_entry,
    check_crc,
    metadata_entries,
    read_chunk,
    record_messages,
    walk,
)

MAX_SUMMARY_BYTES = 64 * 2**20
MAX_METADATA_BYTES = 2**20
MAX_STORED_CHUNK_BYTES = 2**29


class McapFile:
    """The records of an MCAP file whose frame, checksums and metadata have been checked."""

    def __init__(self, data: memoryview) -> None:
        """Check the frame of ``data``, the bytes of a whole file.

        Raises:
            MapFileError: it is no MCAP file, is incomplete, or fails a checksum.
        """
        _check_start(bytes(data[: len(MAGIC)]))
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
        channels: dict[int, Channel] = {}
        for record in self._records:
            if record.opcode == CHUNK:
                chunk = read_chunk(record)
                max_bytes -= chunk.size
                if max_bytes < 0:
                    raise TooLargeMapFileError(
                        f"the chunk at byte {record.start} takes the map over the limit given for "
                        "its size"
                    )
                yield from chunk.messages(channels)
            else:
                yield from record_messages(record, channels)


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


class RandomAccess(Protocol):
    """Where a file's bytes come from."""

    name: str
    size: int  # bytes

    def read(self, offset: int, length: int) -> bytes:
        """Exactly ``length`` bytes from ``offset`` on.

        Raises:
            DamagedMapFileError: there are not so many.
            OSError: they cannot be read.
        """

    def close(self) -> None:
        """Close the source."""


@dataclass(frozen=True)
class _Place:
    """Where a record lies in the file."""

    start: int
    length: int


class McapIndex:
    """The summary of an MCAP file, checked, and with it single chunks and metadata."""

    def __init__(self, source: RandomAccess) -> None:
        """Read the end of the file.

        Raises:
            NoIndexError: it has no index.
            MapFileError: it is no MCAP file, or its end is missing or damaged.
        """
        self._source = source
        _check_start(source.read(0, min(len(MAGIC), source.size)))
        self._channels: dict[int, Channel] = {}
        self._chunks: list[_Place] = []
        self._metadata: list[tuple[str, _Place]] = []
        for record in walk(self._summary(), 0):
            self._add(record)
        if not self._metadata:
            raise NoIndexError("its metadata has no index: triquad-pack rewrites such files")

    @property
    def chunks(self) -> int:
        """Number of chunks, in the order of the file."""
        return len(self._chunks)

    def message(self, number: int) -> Message:
        """The only message of a chunk.

        Raises:
            NoIndexError: it has no checksum, or holds another number of messages.
            MapFileError: it is damaged.
        """
        place = self._chunks[number]
        if place.length > MAX_STORED_CHUNK_BYTES:
            raise DamagedMapFileError(f"the chunk at byte {place.start} is too long")
        chunk = read_chunk(self._record(place, CHUNK))
        if chunk.crc == 0:
            raise NoIndexError(
                f"the chunk at byte {place.start} has no checksum: triquad-pack rewrites such files"
            )
        messages = list(itertools.islice(chunk.messages(dict(self._channels)), 2))
        if len(messages) != 1:
            raise NoIndexError(
                f"the chunk at byte {place.start} does not hold one message: "
                "triquad-pack rewrites such files"
            )
        return messages[0]

    def metadata(self, name: str) -> list[dict[str, str]]:
        """The entries of the metadata record of a name, or nothing.

        Raises:
            DamagedMapFileError: there are several, or it is malformed or too long.
        """
        places = [place for indexed, place in self._metadata if indexed == name]
        if len(places) > 1:
            raise DamagedMapFileError(f"the metadata {name!r} is there more than once")
        if any(place.length > MAX_METADATA_BYTES for place in places):
            raise DamagedMapFileError(f"the metadata at byte {places[0].start} is too long")
        return [metadata_entries(self._record(place, METADATA))[1] for place in places]

    def _summary(self) -> memoryview:
        size, tail = self._source.size, FOOTER_BYTES + len(MAGIC)
        if size < tail + len(MAGIC):
            raise DamagedMapFileError(f"it is incomplete: {size} bytes")
        end = self._source.read(size - tail, tail)
        if end[FOOTER_BYTES:] != MAGIC or end[0] != FOOTER:
            raise DamagedMapFileError("it is incomplete: its footer is missing")
        footer = Fields(next(iter(walk(memoryview(end[:FOOTER_BYTES]), 0))))
        start, _, crc = footer.number(8), footer.number(8), footer.number(4)
        if start == 0 or crc == 0:
            raise NoIndexError(
                "it has no index, or one without a checksum: triquad-pack rewrites such files"
            )
        length = size - tail - start
        if not 0 <= length <= MAX_SUMMARY_BYTES:
            raise DamagedMapFileError(f"its footer names byte {start} as the summary's start")
        summary = self._source.read(start, length)
        check_crc("the summary", summary + end[: FOOTER_BYTES - 4], crc)
        return memoryview(summary)

    def _add(self, record: Record) -> None:
        """Keep what a record of the summary tells."""
        fields = Fields(record)
        if record.opcode == CHANNEL:
            number, channel = channel_entry(record)
            self._channels[number] = channel
        elif record.opcode == CHUNK_INDEX:
            fields.take(16)  # times of the first and last message
            self._chunks.append(_Place(fields.number(8), fields.number(8)))
        elif record.opcode == METADATA_INDEX:
            place = _Place(fields.number(8), fields.number(8))
            self._metadata.append((fields.text(), place))

    def _record(self, place: _Place, opcode: int) -> Record:
        data = memoryview(self._source.read(place.start, place.length))
        records = list(walk(data, 0))
        if len(records) != 1 or records[0].opcode != opcode:
            raise DamagedMapFileError(f"its index is wrong about the record at byte {place.start}")
        return Record(opcode, place.start, records[0].content)


def _check_start(start: bytes) -> None:
    """Refuse what does not begin as an MCAP file does, or is empty."""
    if not start:
        raise DamagedMapFileError("the file is empty")
    if start != MAGIC[: len(start)]:
        raise MapFileError("this is not a map file: it does not begin as MCAP files do")
