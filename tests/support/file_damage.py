"""Map files damaged at a chosen place."""

import io
from dataclasses import dataclass

from mcap.reader import make_reader


@dataclass(frozen=True)
class Chunk:
    """Where a part lies in a file."""

    topic: str
    start: int
    end: int


def chunks(data):
    """The chunks of a file, one to a part, in their order."""
    summary = make_reader(io.BytesIO(data)).get_summary()
    return [
        Chunk(
            summary.channels[next(iter(index.message_index_offsets))].topic,
            index.chunk_start_offset,
            index.chunk_start_offset + index.chunk_length,
        )
        for index in summary.chunk_indexes
    ]


def flipped(data, *places):
    """The bytes with one bit changed at each of these places."""
    corrupt = bytearray(data)
    for place in places:
        corrupt[place] ^= 0x10
    return bytes(corrupt)


def zeroed(data, first, last):
    """The bytes with zeros from ``first`` to before ``last``."""
    return data[:first] + bytes(len(data[first:last])) + data[last:]
