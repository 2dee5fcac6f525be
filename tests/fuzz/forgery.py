"""Forgeries of map files: all checksums and digests fit, so that values are all that is checked.

A forgery is refused, or it is another map, which must be a valid one.
"""

import copy
import math
from typing import Any

import msgpack
import numpy as np
from fuzz.choices import NUMBERS, Draw, Mutation, bomb_bytes, chance, flipped, place, shuffle
from hypothesis import strategies as st
from support.files.mapfile_edit import parts_of, rewritten

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


def forge_bombs(draw: Draw, data: bytes) -> bytes:
    """A part takes far more memory than its file; digests fit."""
    parts = parts_of(data)
    at = place(draw, parts)
    size = bomb_bytes(draw)
    how = draw(st.sampled_from(["zeros", "nested", "column"]))
    if how == "zeros":
        payload = bytes(size)
    elif how == "nested":
        item = draw(st.sampled_from([b"\x90", b"\x80", b"\xa2ab", b"\xcb" + bytes(8)]))
        payload = _nested(item, size)
    else:
        payload = _with_column(draw, parts[at].payload, size)
    if at == len(parts) - 1:
        return rewritten(data, manifest_payload=lambda _: payload)
    return rewritten(data, payloads={at: payload})


def _nested(item: bytes, size: int) -> bytes:
    """Lists of lists of an item, of up to so many bytes."""
    payload = item
    while (count := min(60, size // len(payload))) > 1:
        payload = b"\xdc" + count.to_bytes(2, "big") + count * payload
    return payload


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


def _with_column(draw: Draw, payload: bytes, size: int) -> bytes:
    """A column of a part has so many values."""
    body = _unpacked(payload)
    columns = [value for value in _maps_in(body) if "dtype" in value and value["shape"]]
    if not columns:
        return bytes(size)
    column = columns[place(draw, columns)]
    rows = max(1, math.prod(column["shape"][:-1]))
    column["shape"][-1] = size // rows
    values = rows * (size // rows) * np.dtype(column["dtype"]).itemsize
    column["data"] = bytes([draw(st.integers(0, 1))]) * values
    return _packed(body)


def _maps_in(value: Any) -> list[dict[str, Any]]:
    items = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    inner = [found for item in items for found in _maps_in(item)]
    return [value, *inner] if isinstance(value, dict) else inner


FORGERY: tuple[Mutation, ...] = (forge_bytes, forge_values, forge_manifest)
