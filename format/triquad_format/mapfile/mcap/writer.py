"""Writing MCAP files with one message to a chunk, each compressed as suits it.

The ``mcap`` library's own writer compresses all chunks alike; here its records are put together.
The specification is at https://mcap.dev/spec.
"""

import hashlib
import zlib
from collections import Counter
from collections.abc import Collection, Sequence
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

from triquad_format.mapfile.mcap.records import MAGIC, chunk_limit


class McapWriter:
    """Writes one MCAP file; schemas are known from the start."""

    def __init__(
        self,
        stream: BinaryIO,
        library: str,
        *,
        schemas: Sequence[Schema],
        channels: Sequence[Channel],
    ) -> None:
        """Write what begins the file; ``library`` names the program that writes it."""
        self._stream = stream
        self._digest = hashlib.sha256()
        self._crc = 0
        self.size = 0
        self._schemas = schemas
        self._channels: list[Channel] = []
        self._numbers: dict[str, int] = {}
        self._chunks: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._write(MAGIC)
        for record in (Header("", library), *schemas):
            self._record(record)
        for channel in channels:
            self.add_channel(channel)

    @property
    def topics(self) -> Collection[str]:
        """The topics of its channels."""
        return self._numbers.keys()

    @property
    def sha256(self) -> str:
        """Digest of all that was written, hexadecimal."""
        return self._digest.hexdigest()

    def add_channel(self, channel: Channel) -> None:
        """Describe a channel, before its first message."""
        self._record(channel)
        self._channels.append(channel)
        self._numbers[channel.topic] = channel.id

    def add_metadata(self, name: str, entries: dict[str, str]) -> None:
        """Write a metadata record."""
        start = self.size
        self._record(Metadata(metadata=entries, name=name))
        self._metadata.append(MetadataIndex(start, self.size - start, name))

    def add_message(
        self, topic: str, payload: bytes, *, time_ns: int, level: int, seams: Sequence[int]
    ) -> None:
        """Write a message in a chunk of its own.

        Args:
            topic: of one of the channels.
            payload: what the message holds.
            time_ns: nanoseconds since 1970.
            level: of zstd.
            seams: offsets in the payload where bytes of another kind begin.

        Raises:
            OSError: the stream cannot be written.
        """
        number = self._numbers[topic]
        message = _packed(
            Message(
                channel_id=number, log_time=time_ns, data=payload, publish_time=time_ns, sequence=0
            )
        )
        shift = len(message) - len(payload)
        compressed = _compress(message, [shift + seam for seam in seams], level)
        self._add_chunk(_chunk(message, compressed, time_ns), number)

    def _add_chunk(self, chunk: Chunk, channel: int) -> None:
        """Write a chunk of one message of a channel, and its index."""
        time_ns, start = chunk.message_start_time, self.size
        self._record(chunk)
        index_start = self.size
        self._record(MessageIndex(channel, [(time_ns, 0)]))
        self._chunks.append(
            ChunkIndex(
                chunk_length=index_start - start,
                chunk_start_offset=start,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=time_ns,
                message_index_length=self.size - index_start,
                message_index_offsets={channel: index_start},
                message_start_time=time_ns,
                uncompressed_size=chunk.uncompressed_size,
            )
        )

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
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.METADATA_INDEX, self._metadata),
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
        times = [chunk.message_start_time for chunk in self._chunks]
        # Each chunk holds one message, and its index names the channel.
        counts = Counter(number for c in self._chunks for number in c.message_index_offsets)
        return Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=counts,
            chunk_count=len(self._chunks),
            message_count=len(self._chunks),
            message_end_time=max(times, default=0),
            message_start_time=min(times, default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )

    def _record(self, record: McapRecord) -> None:
        self._write(_packed(record))

    def _write(self, data: bytes) -> None:
        self._stream.write(data)
        self._digest.update(data)
        self._crc = zlib.crc32(data, self._crc)
        self.size += len(data)


def _chunk(message: bytes, compressed: bytes, time_ns: int) -> Chunk:
    """A chunk of one message."""
    # What shrinks by more than readers believe is not compressed.
    shrinks = len(compressed) < len(message) <= chunk_limit(len(compressed))
    return Chunk(
        compression="zstd" if shrinks else "",
        data=compressed if shrinks else message,
        message_end_time=time_ns,
        message_start_time=time_ns,
        uncompressed_crc=zlib.crc32(message),
        uncompressed_size=len(message),
    )


def _packed(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    packed: bytes = builder.end()  # type: ignore[no-untyped-call]
    return packed


def _compress(data: bytes, seams: Sequence[int], level: int) -> bytes:
    """One zstd frame in which a block ends at each seam.

    A block has one Huffman table: noise and numbers in one block compress badly.

    Raises:
        MemoryError: zstd needs memory of its own, and nothing else can fail.
    """
    try:
        return _compressed(data, seams, level)
    except zstandard.ZstdError as error:
        raise MemoryError(str(error)) from error


def _compressed(data: bytes, seams: Sequence[int], level: int) -> bytes:
    compressor = zstandard.ZstdCompressor(level=level).compressobj(size=len(data))
    cuts = [0, *seams, len(data)]
    pieces: list[bytes] = []
    for first, last in zip(cuts[:-1], cuts[1:], strict=True):
        if last > first:
            pieces.append(compressor.compress(data[first:last]))
            pieces.append(compressor.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK))
    pieces.append(compressor.flush())
    return b"".join(pieces)
