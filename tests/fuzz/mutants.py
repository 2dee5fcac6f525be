"""Mutants of map files: what hypothesis draws of where to change them, and to what.

Damage must be found: the file reads back as it was, or is refused. Of a forgery all checksums and
digests fit, so that values are all that is checked: it is refused, or another map, which is valid.
"""

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar

import msgpack
import numpy as np
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy
from support.files.mapfile_edit import parts_of, rewritten, with_fitting_crcs

NUMBERS = (0, 1, 2, 255, 2**16, 2**31, 2**32 - 1, 2**40, 2**62, 2**63 - 1, 2**63, 2**64 - 1)

T = TypeVar("T")


class Draw(Protocol):
    """Draws a value, as the ``draw`` of hypothesis's ``st.data()`` does."""

    def __call__(self, strategy: SearchStrategy[T]) -> T: ...


Mutation = Callable[[Draw, bytes], bytes]


def chance(draw: Draw, percent: int) -> bool:
    return draw(st.integers(0, 99)) < percent


def place(draw: Draw, items: Sequence[object]) -> int:
    return draw(st.integers(0, len(items) - 1))


def number(draw: Draw) -> int:
    return draw(st.sampled_from(NUMBERS))


def shuffle(draw: Draw, items: list[Any]) -> None:
    """Remove, double, swap or overwrite an item."""
    a, b = place(draw, items), place(draw, items)
    how = draw(st.sampled_from(["remove", "double", "swap", "overwrite"]))
    if how == "remove" and len(items) > 1:
        del items[a]
    elif how == "double":
        items.insert(b, items[a])
    elif how == "swap":
        items[a], items[b] = items[b], items[a]
    else:
        items[a] = items[b]


def flipped(draw: Draw, data: bytes, most: int) -> bytes:
    out = bytearray(data)
    for bit in draw(st.lists(st.integers(0, 8 * len(data) - 1), min_size=1, max_size=most)):
        out[bit // 8] ^= 1 << bit % 8
    return bytes(out)


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


def change_numbers(draw: Draw, data: bytes) -> bytes:
    """A number at any place is another, most of them at the end; MCAP's checksums fit."""
    near_end = st.integers(max(0, len(data) - 2000), len(data) - 8)
    at = draw(near_end | st.integers(0, len(data) - 8))
    size = draw(st.sampled_from([1, 2, 4, 8]))
    new = number(draw).to_bytes(8, "little")[:size]
    return with_fitting_crcs(data[:at] + new + data[at + size :])


def change_parts(draw: Draw, data: bytes) -> bytes:
    """Parts are others, doubled or swapped; MCAP's checksums fit, digests do not."""
    payloads = [part.payload for part in parts_of(data)[:-1]]
    at = place(draw, payloads)
    if payloads[at] and draw(st.booleans()):
        payloads[at] = flipped(draw, payloads[at], 3)
    else:
        others = list(payloads)
        shuffle(draw, others)
        payloads = (others + payloads[-1:])[: len(payloads)]
    return rewritten(data, payloads=dict(enumerate(payloads)), fitting=False)


DAMAGE: tuple[Mutation, ...] = (flip_bits, cut, change_numbers, change_parts)


VALUES: tuple[Any, ...] = (
    *NUMBERS, -1, -(2**31), -(2**63), 0.5, -1.0, 1e300, math.nan, math.inf, True, None, "", "x",
    "../x", "<f8", b"", b"\0", [], {}, [[]], [0] * 70, {"dtype": "<f4", "shape": [0], "data": b""},
)  # fmt: skip


def forge_bytes(draw: Draw, data: bytes) -> bytes:
    """Bytes of a part are others; digests fit."""
    return _forged(draw, data, _other_bytes)


def forge_values(draw: Draw, data: bytes) -> bytes:
    """Values of a part are others, or of another kind; digests fit."""
    return _forged(draw, data, _other_values)


def forge_manifest(draw: Draw, data: bytes) -> bytes:
    """The manifest tells something else."""
    change = _other_values if chance(draw, 67) else _other_bytes
    return rewritten(data, manifest_payload=lambda payload: change(draw, payload))


def _forged(draw: Draw, data: bytes, change: Mutation) -> bytes:
    parts = parts_of(data)
    at = place(draw, parts[:-1])
    return rewritten(data, payloads={at: change(draw, parts[at].payload)})


def _other_bytes(draw: Draw, payload: bytes) -> bytes:
    """Most flips hit the heads, where lengths, shapes and keys are."""
    how = draw(st.integers(0, 9))
    if how == 0:
        return payload[: draw(st.integers(0, len(payload)))]
    if how == 1 or not payload:
        return payload + draw(st.binary(min_size=1, max_size=9))
    head = payload[:200] if how < 7 else payload
    return flipped(draw, head, 4) + payload[len(head) :]


def _other_values(draw: Draw, payload: bytes) -> bytes:
    """One or two values of a msgpack map are replaced."""
    body = _unpacked(payload)
    if body is None:
        return _other_bytes(draw, payload)
    for _ in range(draw(st.integers(1, 2))):
        _change_within(draw, body)
    return _packed(body)


def _unpacked(payload: bytes) -> Any:
    """The msgpack map in a payload; ``None`` for a preview, which is no such map."""
    try:
        return msgpack.unpackb(payload)
    except ValueError:
        return None


def _packed(body: Any) -> bytes:
    payload: bytes = msgpack.packb(body)
    return payload


def _change_within(draw: Draw, body: Any) -> None:
    """Replace something at a random depth."""
    if not body:
        return
    keys = list(body) if isinstance(body, dict) else range(len(body))
    key = keys[place(draw, keys)]
    if isinstance(body[key], (dict, list)) and chance(draw, 90):
        _change_within(draw, body[key])
    elif isinstance(body, list) and chance(draw, 30):
        shuffle(draw, body)
    elif isinstance(body, dict) and chance(draw, 20):
        del body[key]
    else:
        body[key] = _other_value(draw, body[key])


def _other_value(draw: Draw, value: Any) -> Any:
    if isinstance(value, bytes) and value and chance(draw, 90):
        if chance(draw, 50):
            return flipped(draw, value, 8)
        return bytes([draw(st.sampled_from([0, 1, 0x7F, 0x80, 0xFF]))]) * len(value)
    if isinstance(value, int) and chance(draw, 50):
        return min(max(0, value + draw(st.sampled_from([-2, -1, 1, 2]))), 2**64 - 1)
    return copy.deepcopy(draw(st.sampled_from(VALUES)))


FORGERY: tuple[Mutation, ...] = (forge_bytes, forge_values, forge_manifest)
