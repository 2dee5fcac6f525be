"""Ways to spoil a map file, each a step closer to its values.

Damage must be found: the file reads back as it was, or is refused. Forgery, where all digests and
checksums were made to fit, may give another map, which must be a sound one.
"""

import copy
import hashlib
import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import msgpack
import numpy as np
from triquad_format.mapfile.mcap.records import CHUNK, MAGIC

from triquad_tools.sealed_mcap import (
    Dissected,
    LooseMessage,
    Piece,
    chunk,
    chunk_records,
    dissect,
    packed,
    rebuilt,
    sealed,
)

_MAX_BOMB_BYTES = 24 * 2**20
_NUMBERS = (0, 1, 2, 255, 2**16, 2**31, 2**32 - 1, 2**40, 2**62, 2**63 - 1, 2**63, 2**64 - 1)
_VALUES: tuple[Any, ...] = (
    *_NUMBERS, -1, -(2**31), -(2**63), 0.5, -1.0, 1e300, math.nan, math.inf, True, None, "", "x",
    "../x", "<f8", b"", b"\0", [], {}, [[]], [0] * 70, {"dtype": "<f4", "shape": [0], "data": b""},
)  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    """A spoilt file."""

    data: bytes
    forged: bool


Mutation = Callable[[random.Random, bytes], Mutant]


def flip_bits(rng: random.Random, data: bytes) -> Mutant:
    """Some bits flipped anywhere."""
    return Mutant(_flipped(rng, data, rng.randint(1, 8)), False)


def cut(rng: random.Random, data: bytes) -> Mutant:
    """Bytes missing, doubled, moved, zeroed or replaced by noise."""
    a, b = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    middles = (b"", data[a:b] * 2, bytes(b - a), rng.randbytes(b - a))
    mutants = [data[:a], data[:a] + data[b:] + data[a:b]]
    mutants += [data[:a] + middle + data[b:] for middle in middles]
    return Mutant(rng.choice(mutants), False)


def lie_in_heads(rng: random.Random, data: bytes) -> Mutant:
    """A number in the head of a record, or in the index, is another; checksums of MCAP fit."""
    pieces = list(_dissected(data).pieces)
    if rng.random() < 0.3:
        return Mutant(sealed(pieces, lambda summary: _with_number(rng, summary, 8)), False)
    at = rng.randrange(len(pieces))
    opcode, content = pieces[at].opcode, pieces[at].content
    if opcode == CHUNK and rng.random() < 0.8:
        head = bytearray(content[:48])
        offset, size = rng.choice(((16, 8), (24, 4), (28, 4), (32, 8), (36, 8), (40, 8)))
        head[offset : offset + size] = rng.choice(_NUMBERS).to_bytes(8, "little")[:size]
        pieces[at] = Piece(opcode, bytes(head) + content[48:])
    elif rng.random() < 0.5:
        pieces[at] = Piece(opcode, _flipped(rng, content, 2) if content else b"\0")
    else:
        pieces[at] = Piece(opcode, _with_number(rng, content, 4))
    return Mutant(sealed(pieces), False)


def lie_in_lengths(rng: random.Random, data: bytes) -> Mutant:
    """The length of a record is another, in the file or within a chunk."""
    pieces = list(_dissected(data).pieces)
    if rng.random() < 0.5:
        starts = np.cumsum([len(MAGIC), *(len(packed(piece)) for piece in pieces)]).tolist()
        return Mutant(_patched(data, rng.choice(starts) + 1, rng.choice(_NUMBERS), 8), False)
    at = rng.choice([i for i, piece in enumerate(pieces) if piece.opcode == CHUNK])
    records = chunk_records(pieces[at])
    lengths = (*_NUMBERS, max(0, len(records) + rng.randint(-40, 40)))
    declared = rng.choice((None, len(records) + rng.randint(-3, 3), *_NUMBERS))
    spoilt = _patched(records, 1, rng.choice(lengths), 8)
    pieces[at] = chunk(spoilt, rng.random() < 0.5, declared)
    return Mutant(sealed(pieces), False)


def shuffle_records(rng: random.Random, data: bytes) -> Mutant:
    """Records missing, doubled, swapped, or taken into each other's place; checksums fit."""
    pieces = list(_dissected(data).pieces)
    for _ in range(rng.randint(1, 2)):
        _shuffle(rng, pieces)
    return Mutant(sealed(pieces), False)


def _shuffle(rng: random.Random, items: list[Any]) -> None:
    """Remove, double, swap or overwrite an item."""
    a, b = rng.randrange(len(items)), rng.randrange(len(items))
    step = rng.randrange(4)
    if step == 0 and len(items) > 1:
        del items[a]
    elif step == 1:
        items.insert(b, items[a])
    elif step == 2:
        items[a], items[b] = items[b], items[a]
    else:
        items[a] = items[b]


def spoil_parts(rng: random.Random, data: bytes) -> Mutant:
    """Parts are others, missing, doubled or swapped; checksums fit, digests do not."""
    dissected = _dissected(data)
    *parts, manifest = dissected.messages
    if rng.random() < 0.7:
        at = rng.randrange(len(parts))
        payload = _flipped(rng, parts[at].payload, rng.randint(1, 3))
        parts[at] = replace(parts[at], payload=payload)
    else:
        _shuffle(rng, parts)
    return Mutant(rebuilt(dissected.pieces, [*parts, manifest]), False)


def forge_bytes(rng: random.Random, data: bytes) -> Mutant:
    """Bytes of a part are others; digests fit."""
    return _forged(rng, data, lambda payload: _spoilt_bytes(rng, payload))


def forge_values(rng: random.Random, data: bytes) -> Mutant:
    """Values of a part are others, or of another kind; digests fit."""
    return _forged(rng, data, lambda payload: _spoilt_values(rng, payload))


def forge_manifest(rng: random.Random, data: bytes) -> Mutant:
    """The manifest tells something else."""
    dissected = _dissected(data)
    parts = list(dissected.messages)
    manifest = parts[-1]
    spoil = rng.choice((_spoilt_bytes, _spoilt_values, _spoilt_values))
    parts[-1] = replace(manifest, payload=spoil(rng, manifest.payload))
    return Mutant(rebuilt(dissected.pieces, parts), True)


def explode(rng: random.Random, data: bytes) -> Mutant:
    """A part, or parts, that take far more memory than their file."""
    dissected = _dissected(data)
    parts = list(dissected.messages)
    at = rng.randrange(len(parts))
    size = int(_MAX_BOMB_BYTES * rng.random() ** 2)
    step = rng.randrange(5)
    if step == 0:
        parts[at] = replace(parts[at], payload=bytes(size))
    elif step == 1:
        item = rng.choice((b"\x90", b"\x80", b"\xa2ab", b"\xcb" + bytes(8)))
        parts[at] = replace(parts[at], payload=_nested(item, size))
    elif step == 2:
        parts[at] = replace(parts[at], payload=_with_column(rng, parts[at].payload, size))
    elif step == 3:
        parts[at:at] = [LooseMessage("/triquad/x", "msgpack", b"")] * (size // 1024)
        return Mutant(rebuilt(dissected.pieces, parts), False)
    else:
        pieces = [*dissected.pieces, chunk(bytes(size), True, rng.choice((None, *_NUMBERS)))]
        return Mutant(sealed(pieces), False)
    return Mutant(rebuilt(dissected.pieces, _relisted(parts, at), compressed=True), True)


MUTATIONS: dict[str, tuple[Mutation, float]] = {
    "bits": (flip_bits, 12),
    "cuts": (cut, 12),
    "heads": (lie_in_heads, 14),
    "lengths": (lie_in_lengths, 14),
    "records": (shuffle_records, 10),
    "parts": (spoil_parts, 8),
    "part bytes": (forge_bytes, 10),
    "part values": (forge_values, 10),
    "manifest": (forge_manifest, 9.8),
    "bombs": (explode, 0.2),
}
"""Each mutation with its share of all, per cent."""


@lru_cache(maxsize=64)
def _dissected(data: bytes) -> Dissected:
    return dissect(data)


def _forged(rng: random.Random, data: bytes, spoil: Callable[[bytes], bytes]) -> Mutant:
    dissected = _dissected(data)
    parts = list(dissected.messages)
    at = rng.randrange(len(parts) - 1)
    parts[at] = replace(parts[at], payload=spoil(parts[at].payload))
    return Mutant(rebuilt(dissected.pieces, _relisted(parts, at), rng.random() < 0.2), True)


def _relisted(parts: Sequence[LooseMessage], at: int) -> list[LooseMessage]:
    """The parts, with what the manifest tells of one that changed, unless it is the manifest."""
    *others, manifest = parts
    if at == len(others):
        return list(parts)
    body = msgpack.unpackb(manifest.payload)
    columns = body["parts"]
    payload = parts[at].payload
    size, digest = len(payload), hashlib.sha256(payload).digest()
    if isinstance(columns, list):
        columns[at].update(bytes=size, sha256=digest)
    else:
        row = np.flatnonzero(np.frombuffer(columns["file"]["data"], "<u2") == 0).tolist()[at]
        columns["bytes"]["data"] = _patched(columns["bytes"]["data"], 8 * row, size, 8)
        digests = columns["sha256"]["data"]
        columns["sha256"]["data"] = digests[: 32 * row] + digest + digests[32 * (row + 1) :]
    return [*others, replace(manifest, payload=msgpack.packb(body))]


def _spoilt_bytes(rng: random.Random, payload: bytes) -> bytes:
    """Most flips hit the heads, where lengths, shapes and keys are."""
    step = rng.random()
    if step < 0.1:
        return payload[: rng.randrange(len(payload) + 1)]
    if step < 0.2:
        return payload + rng.randbytes(rng.randint(1, 9))
    out = bytearray(payload)
    for _ in range(rng.randint(1, 4)):
        out[int(len(out) * rng.random() ** 3)] ^= 1 << rng.randrange(8)
    return bytes(out)


def _spoilt_values(rng: random.Random, payload: bytes) -> bytes:
    """One or two values of a msgpack map are replaced."""
    try:
        body = msgpack.unpackb(payload)
    except ValueError:
        return _spoilt_bytes(rng, payload)
    for _ in range(rng.randint(1, 2)):
        _spoil_within(rng, body)
    spoilt: bytes = msgpack.packb(body)
    return spoilt


def _spoil_within(rng: random.Random, body: Any) -> None:
    """Replace something at a random depth."""
    if not body:
        return
    key = rng.choice(list(body)) if isinstance(body, dict) else rng.randrange(len(body))
    if isinstance(body[key], (dict, list)) and rng.random() < 0.9:
        _spoil_within(rng, body[key])
    elif isinstance(body, list) and rng.random() < 0.3:
        _shuffle(rng, body)
    elif isinstance(body, dict) and rng.random() < 0.2:
        del body[key]
    else:
        body[key] = _spoilt_value(rng, body[key])


def _spoilt_value(rng: random.Random, value: Any) -> Any:
    if isinstance(value, bytes) and value and rng.random() < 0.9:
        if rng.random() < 0.5:
            return _flipped(rng, value, rng.randint(1, 8))
        return bytes([rng.choice((0, 1, 0x7F, 0x80, 0xFF))]) * len(value)
    if isinstance(value, int) and rng.random() < 0.5:
        return min(max(0, value + rng.choice((-2, -1, 1, 2))), 2**64 - 1)
    return copy.deepcopy(rng.choice(_VALUES))


def _with_column(rng: random.Random, payload: bytes, size: int) -> bytes:
    """A column of a part is of so many bytes."""
    try:
        body = msgpack.unpackb(payload)
    except ValueError:
        return bytes(size)
    columns = [value for value in _maps_in(body) if "dtype" in value and value["shape"]]
    if columns:
        column = rng.choice(columns)
        rows = max(1, math.prod(column["shape"][:-1]))
        column["shape"][-1] = size // rows
        width = np.dtype(column["dtype"]).itemsize
        column["data"] = bytes([rng.randrange(2)]) * (rows * (size // rows) * width)
    wide: bytes = msgpack.packb(body)
    return wide


def _maps_in(value: Any) -> list[dict[str, Any]]:
    items = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    inner = [found for item in items for found in _maps_in(item)]
    return [value, *inner] if isinstance(value, dict) else inner


def _nested(item: bytes, size: int) -> bytes:
    """Lists of lists of an item, of up to so many bytes."""
    payload = item
    while 60 * len(payload) < size:
        payload = b"\xdc\x00\x3c" + 60 * payload
    return payload


def _flipped(rng: random.Random, data: bytes, count: int) -> bytes:
    out = bytearray(data)
    for _ in range(count):
        out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def _with_number(rng: random.Random, data: bytes, size: int) -> bytes:
    """Another number at any place."""
    if len(data) < size:
        return data + b"\0"
    return _patched(data, rng.randrange(len(data) - size + 1), rng.choice(_NUMBERS), size)


def _patched(data: bytes, at: int, number: int, size: int) -> bytes:
    stored = number.to_bytes(8, "little")[:size]
    return data[:at] + stored + data[at + size :]
