"""Single messages of an MCAP file by its index, without reading the rest of the file."""

import itertools
from dataclasses import dataclass

from triquad_format.errors import DamagedMapFileError, MapFileError, NoIndexError
from triquad_format.mapfile.files import RandomAccess
from triquad_format.mapfile.mcap.chunks import chunk_crc, chunk_messages
from triquad_format.mapfile.mcap.records import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    FOOTER,
    FOOTER_BYTES,
    MAGIC,
    METADATA,
    METADATA_INDEX,
    Channel,
    Fields,
    Message,
    Record,
    channel_entry,
    check_crc,
    metadata_entries,
    walk,
)

MAX_SUMMARY_BYTES = 64 * 2**20
MAX_METADATA_BYTES = 2**20
MAX_STORED_CHUNK_BYTES = 2**29


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
        if source.size == 0:
            raise DamagedMapFileError("the file is empty")
        head = source.read(0, min(len(MAGIC), source.size))
        if head != MAGIC[: len(head)]:
            raise MapFileError("this is not a map file: it does not begin as MCAP files do")
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
        record = self._record(place, CHUNK)
        if chunk_crc(record) == 0:
            raise NoIndexError(
                f"the chunk at byte {place.start} has no checksum: triquad-pack rewrites such files"
            )
        messages = list(itertools.islice(chunk_messages(record, dict(self._channels)), 2))
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
        found = []
        for place in places:
            if place.length > MAX_METADATA_BYTES:
                raise DamagedMapFileError(f"the metadata at byte {place.start} is too long")
            found.append(metadata_entries(self._record(place, METADATA))[1])
        return found

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
