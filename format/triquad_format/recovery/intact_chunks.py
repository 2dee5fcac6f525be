"""The intact chunks of an MCAP file of which anything else may be damaged or missing.

Nothing in the file tells where a chunk is: each is found by how it begins, and told from chance by
its checksum. So nothing that is damaged hides what lies behind it.
"""

import contextlib
import re
from collections.abc import Iterator

from triquad_format.errors import FormatError, TooLargeMapFileError
from triquad_format.mapfile.mcap.chunks import chunk_messages, declared_size
from triquad_format.mapfile.mcap.records import (
    Channel,
    Message,
    Record,
    metadata_entries,
)
from triquad_format.mapfile.metadata import METADATA_NAME
from triquad_format.mapfile.parts.part import ENCODINGS

_HEAD_BYTES = 9  # of a record: opcode and length

_LEAST_BUDGET, _BUDGET_RATIO = 2**24, 8
"""Bytes of all places that are tried: a constant, and a multiple of the file's size."""

# A record below 4 GiB; in a chunk then times, size and checksum, and the name of its compression.
_CHUNK = re.compile(rb"\x06.{4}\x00{4}.{28}(?:\x04\x00{3}zstd|\x00{4})", re.DOTALL)
_METADATA = re.compile(rb"\x0c.{4}\x00{4}\x07\x00{3}" + METADATA_NAME.encode(), re.DOTALL)
_CHANNEL = re.compile(rb"\x04.{4}\x00{4}(..)...\x00{3}(/[a-z/]+).\x00{3}([a-z]+)\x00{4}", re.DOTALL)


def intact_messages(data: bytes, max_bytes: int) -> Iterator[Message]:
    """The messages of all intact chunks, in the order of the file.

    Args:
        data: what there is of the file.
        max_bytes: limit on all decompressed chunks together.

    Raises:
        TooLargeMapFileError: there is more.
    """
    channels = _channels(data)
    budget = _LEAST_BUDGET + _BUDGET_RATIO * len(data)
    at = 0
    while match := _CHUNK.search(data, at):
        at = match.start() + 1
        record = _record(data, match.start())
        if record is None or len(record.content) > budget:
            continue
        budget -= len(record.content)
        try:
            messages = list(chunk_messages(record, dict(channels)))
        except FormatError:
            continue
        max_bytes -= declared_size(record)
        if max_bytes < 0:
            raise TooLargeMapFileError("its intact chunks exceed the limit given for its size")
        yield from messages
        at = record.end


def found_metadata(data: bytes) -> dict[str, str]:
    """The entries of the first metadata record ``triquad`` that can be read; empty: of none."""
    for match in _METADATA.finditer(data):
        record = _record(data, match.start())
        with contextlib.suppress(FormatError):
            if record is not None:
                return metadata_entries(record)[1]
    return {}


def _record(data: bytes, start: int) -> Record | None:
    """The record that begins at ``start``, if the file has all of it."""
    first = start + _HEAD_BYTES
    length = int.from_bytes(data[start + 1 : first], "little")
    if first + length > len(data):
        return None
    return Record(data[start], start, memoryview(data)[first : first + length])


def _channels(data: bytes) -> dict[int, Channel]:
    """Channels by number: as records in the file say, else as files are written.

    The records stand twice in a file, and have no checksum of their own.
    """
    usual = [Channel(topic, encoding) for topic, encoding in ENCODINGS.items()]
    channels = dict(enumerate(usual, start=1))
    for match in _CHANNEL.finditer(data):
        channel = Channel(match[2].decode(), match[3].decode())
        if channel in usual:
            channels[int.from_bytes(match[1], "little")] = channel
    return channels
