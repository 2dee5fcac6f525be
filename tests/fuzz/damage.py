"""Damage of map files. It must be found: the file reads back as it was, or is refused."""

import numpy as np
from fuzz.choices import (
    NUMBERS,
    Draw,
    Mutation,
    bomb_bytes,
    chance,
    flipped,
    number,
    place,
    shuffle,
)
from fuzz.mcap_edit import RawRecord, checksummed, chunk, chunk_records, packed, records_of
from hypothesis import strategies as st
from support.mapfile_edit import RawPart, metadata_of, parts_of, rebuild
from triquad_format.mapfile.mcap.records import CHUNK, MAGIC

CHUNK_HEAD = ((16, 8), (24, 4), (28, 4), (32, 8), (36, 8), (40, 8))
"""Offset and size of the numbers in the head of a chunk."""


def flip_bits(draw: Draw, data: bytes) -> bytes:
    """Some bits are flipped anywhere."""
    return flipped(draw, data, 8)


def cut(draw: Draw, data: bytes) -> bytes:
    """Bytes are missing, doubled, moved, zeroed or replaced by noise."""
    a, b = sorted(draw(st.integers(0, len(data))) for _ in range(2))
    first, middle, last = data[:a], data[a:b], data[b:]
    noise = np.random.default_rng(a).bytes(b - a)
    cuts = [first, first + last + middle]
    cuts += [first + other + last for other in (b"", middle * 2, bytes(b - a), noise)]
    return cuts[place(draw, cuts)]


def change_heads(draw: Draw, data: bytes) -> bytes:
    """A number in the head of a record or in the index is another; MCAP's checksums fit."""
    records = records_of(data)
    if chance(draw, 30):
        return checksummed(records, lambda summary: _with_number(draw, summary, 8))
    at = place(draw, records)
    opcode, content = records[at]
    if opcode == CHUNK and chance(draw, 80):
        content = _patched(content, *draw(st.sampled_from(CHUNK_HEAD)), number(draw))
    elif content and chance(draw, 50):
        content = flipped(draw, content, 2)
    else:
        content = _with_number(draw, content, 4)
    records[at] = RawRecord(opcode, content)
    return checksummed(records)


def change_lengths(draw: Draw, data: bytes) -> bytes:
    """The length of a record is another, in the file or within a chunk."""
    records = records_of(data)
    if chance(draw, 50):
        starts = np.cumsum([len(MAGIC), *(len(packed(record)) for record in records)]).tolist()
        return _patched(data, starts[place(draw, starts)] + 1, 8, number(draw))
    at = draw(st.sampled_from([i for i, record in enumerate(records) if record.opcode == CHUNK]))
    inner = chunk_records(records[at])
    length = draw(st.sampled_from(NUMBERS) | st.integers(-40, 40).map(len(inner).__add__))
    near = st.integers(-3, 3).map(len(inner).__add__)
    declared = draw(st.none() | near | st.sampled_from(NUMBERS))
    changed = _patched(inner, 1, 8, max(0, length))
    records[at] = chunk(changed, compressed=chance(draw, 50), declared=declared)
    return checksummed(records)


def shuffle_records(draw: Draw, data: bytes) -> bytes:
    """Records are missing, doubled, swapped or in each other's place; MCAP's checksums fit."""
    records = records_of(data)
    for _ in range(draw(st.integers(1, 2))):
        shuffle(draw, records)
    return checksummed(records)


def change_parts(draw: Draw, data: bytes) -> bytes:
    """Parts are others, missing, doubled or swapped; MCAP's checksums fit, digests do not."""
    *parts, manifest = parts_of(data)
    at = place(draw, parts)
    if parts[at].payload and chance(draw, 70):
        parts[at] = parts[at]._replace(payload=flipped(draw, parts[at].payload, 3))
    else:
        shuffle(draw, parts)
    return rebuild([*parts, manifest], metadata_of(data))


def add_bombs(draw: Draw, data: bytes) -> bytes:
    """Parts or a chunk that the manifest does not list, and that take far more than their file."""
    size = bomb_bytes(draw)
    if chance(draw, 50):
        extra = chunk(
            bytes(size), compressed=True, declared=draw(st.none() | st.sampled_from(NUMBERS))
        )
        return checksummed([*records_of(data), extra])
    *parts, manifest = parts_of(data)
    parts += [RawPart("/triquad/x", b"")] * (size // 1024)
    return rebuild([*parts, manifest], metadata_of(data))


def _with_number(draw: Draw, data: bytes, size: int) -> bytes:
    """Another number at any place."""
    if len(data) < size:
        return data + b"\0"
    return _patched(data, draw(st.integers(0, len(data) - size)), size, number(draw))


def _patched(data: bytes, at: int, size: int, number: int) -> bytes:
    return data[:at] + number.to_bytes(8, "little")[:size] + data[at + size :]


DAMAGE: tuple[Mutation, ...] = (
    flip_bits,
    cut,
    change_heads,
    change_lengths,
    shuffle_records,
    change_parts,
)
