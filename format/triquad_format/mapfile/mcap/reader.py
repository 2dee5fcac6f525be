"""MCAP files read front to back, with every checksum checked.

The summary is not needed, but its checksum is checked where there is one. Unknown records are
skipped, as the specification demands.
"""

from collections.abc import Iterator

from triquad_format.errors import DamagedMapFileError, MapFileError, TooLargeMapFileError
from triquad_format.mapfile.mcap.chunks import chunk_messages, declared_size
from triquad_format.mapfile.mcap.records import (
    CHUNK,
    DATA_END,
    FOOTER,
    HEADER,
    MAGIC,
    MESSAGE,
    METADATA,
    Channel,
    Fields,
    Message,
    Record,
    check_crc,
    metadata_entries,
    record_messages,
    walk,
)


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
        channels: dict[int, Channel] = {}
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
