"""Writing MCAP files with one message to a chunk, each compressed as suits it.

The ``mcap`` library's own writer compresses all chunks alike; here its records are put together.
The specification is at https://mcap.dev/spec.
"""

import hashlib
import zlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import BinaryIO

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from triquad_format.mapfile.mcap.chunks import chunk_limit
from triquad_format.mapfile.mcap.records import MAGIC


@dataclass(frozen=True)
class ChannelSpec:
    """A channel, and how the chunks of its messages are compressed."""

    number: int
    topic: str
    encoding: str
    level: int  # of zstd
    schema: str = ""  # name of its schema, if it has one


@dataclass(frozen=True)
class SchemaSpec:
    """A schema of messages."""

    name: str
    encoding: str
    data: bytes


@dataclass
class _Summary:
    """What the summary section tells of what was written."""

    chunks: list[ChunkIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)


class McapWriter:
    """Writes one MCAP file; schemas and channels are known from the start."""

    def __init__(
        self,
        stream: BinaryIO,
        library: str,
        *,
        schemas: Sequence[SchemaSpec],
        channels: Sequence[ChannelSpec],
    ) -> None:
        """Write what begins the file; ``library`` names the program that writes it."""
        self._stream = stream
        self._digest = hashlib.sha256()
        self._crc = 0
        self.size = 0
        self._summary = _Summary()
        self._schemas = _schema_records(schemas)
        self._channels = _channel_records(channels, self._schemas)
        self._specs = {spec.topic: spec for spec in channels}
        self._write(MAGIC)
        self._record(Header("", library))
        for record in (*self._schemas, *self._channels):
            self._record(record)

    @property
    def topics(self) -> Collection[str]:
        """The topics of its channels."""
        return self._specs.keys()

    @property
    def sha256(self) -> str:
        """Digest of all that was written, hexadecimal."""
        return self._digest.hexdigest()

    def add_metadata(self, name: str, entries: dict[str, str]) -> None:
        """Write a metadata record."""
        start = self.size
        self._record(Metadata(metadata=entries, name=name))
        self._summary.metadata.append(MetadataIndex(start, self.size - start, name))

    def add_message(
        self, topic: str, payload: bytes, *, time_ns: int, seams: Sequence[int]
    ) -> None:
        """Write a message in a chunk of its own.

        Args:
            topic: of one of the channels.
            payload: what the message holds.
            time_ns: of the message, nanoseconds since 1970.
            seams: offsets in the payload where bytes of another kind begin.

        Raises:
            OSError: the stream cannot be written.
        """
        spec = self._specs[topic]
        number = spec.number
        chunk = _chunk(spec, payload, time_ns=time_ns, seams=seams)
        start = self.size
        self._record(chunk)
        index_start = self.size
        self._record(MessageIndex(number, [(time_ns, 0)]))
        self._summary.chunks.append(_chunk_index(chunk, number, (start, index_start, self.size)))
        self._summary.counts[number] = self._summary.counts.get(number, 0) + 1

    def finish(self) -> None:
        """Write the summary and what ends the file; the stream stays open."""
        self._record(DataEnd(self._crc))
        summary_start = self.size
        summary = RecordBuilder()
        offsets: list[SummaryOffset] = []
        groups: list[tuple[int, Sequence[McapRecord]]] = [
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._summary.chunks),
            (Opcode.METADATA_INDEX, self._summary.metadata),
        ]
        for opcode, records in groups:
            group_start = summary.count
            for record in records:
                record.write(summary)
            if records:
                length = summary.count - group_start
                offsets.append(SummaryOffset(opcode, summary_start + group_start, length))
        offsets_start = summary_start + summary.count
        for offset in offsets:
            offset.write(summary)
        data = summary.end()  # type: ignore[no-untyped-call]
        footer = _packed(Footer(summary_start, offsets_start, 0))
        crc = zlib.crc32(footer[:-4], zlib.crc32(data))
        self._write(data)
        self._write(_packed(Footer(summary_start, offsets_start, crc)))
        self._write(MAGIC)

    def _statistics(self) -> Statistics:
        times = [chunk.message_start_time for chunk in self._summary.chunks]
        return Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=self._summary.counts,
            chunk_count=len(self._summary.chunks),
            message_count=len(self._summary.chunks),
            message_end_time=max(times, default=0),
            message_start_time=min(times, default=0),
            metadata_count=len(self._summary.metadata),
            schema_count=len(self._schemas),
        )

    def _record(self, record: McapRecord) -> None:
        self._write(_packed(record))

    def _write(self, data: bytes) -> None:
        self._stream.write(data)
        self._digest.update(data)
        self._crc = zlib.crc32(data, self._crc)
        self.size += len(data)


def _schema_records(specs: Sequence[SchemaSpec]) -> list[Schema]:
    return [
        Schema(id=number, data=spec.data, encoding=spec.encoding, name=spec.name)
        for number, spec in enumerate(specs, start=1)
    ]


def _channel_records(specs: Sequence[ChannelSpec], schemas: Sequence[Schema]) -> list[Channel]:
    numbers = {schema.name: schema.id for schema in schemas}
    return [
        Channel(
            id=spec.number,
            topic=spec.topic,
            message_encoding=spec.encoding,
            metadata={},
            schema_id=numbers.get(spec.schema, 0),
        )
        for spec in specs
    ]


def _chunk(spec: ChannelSpec, payload: bytes, *, time_ns: int, seams: Sequence[int]) -> Chunk:
    """A chunk of one message."""
    message = _packed(
        Message(
            channel_id=spec.number,
            log_time=time_ns,
            data=payload,
            publish_time=time_ns,
            sequence=0,
        )
    )
    shift = len(message) - len(payload)
    stored = _compress(message, [shift + seam for seam in seams], spec.level)
    # What shrinks by more than readers believe is not compressed.
    shrinks = len(stored) < len(message) <= chunk_limit(len(stored))
    return Chunk(
        compression="zstd" if shrinks else "",
        data=stored if shrinks else message,
        message_end_time=time_ns,
        message_start_time=time_ns,
        uncompressed_crc=zlib.crc32(message),
        uncompressed_size=len(message),
    )


def _chunk_index(chunk: Chunk, channel: int, places: tuple[int, int, int]) -> ChunkIndex:
    """What the summary tells of a chunk; ``places`` are where it, its index and the next begin."""
    start, index_start, end = places
    return ChunkIndex(
        chunk_length=index_start - start,
        chunk_start_offset=start,
        compression=chunk.compression,
        compressed_size=len(chunk.data),
        message_end_time=chunk.message_end_time,
        message_index_length=end - index_start,
        message_index_offsets={channel: index_start},
        message_start_time=chunk.message_start_time,
        uncompressed_size=chunk.uncompressed_size,
    )


def _packed(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    packed: bytes = builder.end()  # type: ignore[no-untyped-call]
    return packed


def _compress(data: bytes, seams: Sequence[int], level: int) -> bytes:
    """One zstd frame in which a block ends at each seam.

    A block has one Huffman table: noise and numbers in one block compress badly.
    """
    compressor = zstandard.ZstdCompressor(level=level).compressobj(size=len(data))
    cuts = [0, *seams, len(data)]
    pieces: list[bytes] = []
    for first, last in zip(cuts[:-1], cuts[1:], strict=True):
        if last > first:
            pieces.append(compressor.compress(data[first:last]))
            pieces.append(compressor.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK))
    pieces.append(compressor.flush())
    return b"".join(pieces)
