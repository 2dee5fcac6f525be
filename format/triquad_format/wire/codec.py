"""Encoding of messages: one generic pair of functions, driven by the dataclasses' annotations.

A message is a msgpack map that has ``triquad`` (the protocol version), ``kind`` (the name of
its class) and its fields; an array is one of its dtype, shape and raw little-endian bytes. The
messages themselves are in :mod:`triquad_format.wire.messages`; ``docs/wire-protocol.md`` is the
specification.

Before a message is unpacked, its structure is checked. A few megabytes can contain millions of tiny
objects, or nest thousands deep; unpacking them would block everything else for seconds and take
a hundred times their size. The headers alone are read, whose bytes are those of
https://github.com/msgpack/msgpack/blob/master/spec.md
"""

import functools
import math
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar, get_args, get_origin

import msgpack
import numpy as np
from numpy.typing import NDArray

from triquad_format.errors import ProtocolVersionError, WireError

PROTOCOL_VERSION = 1
MAX_MESSAGE_BYTES = 256 * 2**20
_MAX_WIRE_STRING_BYTES = 65_536
_MAX_ITEMS = 65_536
MAX_OBJECTS = 20_000
_MAX_DEPTH = 16
# To begin with: a refusal for want of memory must not want 256 KiB.
_BUFFER_BYTES = 4096

_ITEM_BYTES = {
    name: np.dtype(name).itemsize
    for name in ("|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f2", "<f4", "<f8")
}
"""The dtypes of arrays that travel, and how many bytes an item of each has."""

_ARRAY_KEYS = {"dtype", "shape", "data"}
_MAX_DIMENSIONS = 4
_MAX_SIZE = 2**40  # of an array along one axis, and of all axes together

# How many bytes follow the first of a header: a length, or a count.
_LENGTH_BYTES = {0xC4: 1, 0xC5: 2, 0xC6: 4, 0xD9: 1, 0xDA: 2, 0xDB: 4}  # binaries and strings
_COUNT_BYTES = {0xDC: 2, 0xDD: 4, 0xDE: 2, 0xDF: 4}  # arrays and maps


def _sizes() -> bytes:
    """Return an object's size by its first byte; 0: it does not give it, or contains others."""
    sizes = bytearray(256)
    for code in (*range(0x80), *range(0xE0, 0x100), 0xC0, 0xC2, 0xC3):  # small numbers, nil, truth
        sizes[code] = 1
    for code in range(0xA0, 0xC0):  # short strings
        sizes[code] = 1 + (code & 0x1F)
    for code, size in zip(range(0xCA, 0xD4), (4, 8, 1, 2, 4, 8, 1, 2, 4, 8), strict=True):
        sizes[code] = 1 + size  # numbers
    return bytes(sizes)


_SIZES = _sizes()

MessageT = TypeVar("MessageT", bound="Message")


class Message:
    """Base of all wire messages; subclasses are frozen dataclasses."""

    @classmethod
    @functools.cache
    def annotations(cls) -> dict[str, Any]:
        """Return the fields' names and annotations."""
        return typing.get_type_hints(cls, include_extras=True)

    @classmethod
    @functools.cache
    def forms(cls) -> dict[str, "Form"]:
        """Return how each field travels, by its name."""
        return {name: _form(annotation) for name, annotation in cls.annotations().items()}


@dataclass(frozen=True)
class ArraySpec:
    """The arrays that a message's field accepts: one dtype, and sizes per axis (``None``: any)."""

    dtype: str
    shape: tuple[int | None, ...]

    def check(self, name: str, array: NDArray[np.generic]) -> None:
        """Raise :class:`WireError` naming ``name`` where ``array`` does not fit."""
        if array.dtype.str != self.dtype or not self._fits(array.shape):
            shape = ", ".join("N" if size is None else str(size) for size in self.shape)
            raise WireError(
                f"{name}: expected an array [{shape}] of {self.dtype}, "
                f"got {list(array.shape)} of {array.dtype.str}"
            )

    def _fits(self, shape: tuple[int, ...]) -> bool:
        # Not by all(): every message comes by here, and a generator takes longer than the rest.
        for want, have in zip(self.shape, shape, strict=False):
            if want is not None and want != have:
                return False
        return len(shape) == len(self.shape)


def encode(message: Message) -> bytes:
    """Return the bytes of a message.

    Raises:
        WireError: a field does not fit its annotation.
    """
    kind = type(message).__name__
    body = {"triquad": PROTOCOL_VERSION, "kind": kind, **_pack_fields(kind, message)}
    return typing.cast(bytes, msgpack.packb(body, buf_size=_BUFFER_BYTES))


def decode(expected: type[MessageT], payload: bytes) -> MessageT:
    """Return the message in ``payload``, which must be of the class ``expected``.

    Unknown fields are ignored, so that a later minor revision can add some.

    Raises:
        ProtocolVersionError: the message names another protocol version.
        WireError: anything else is wrong; the text names the field.
    """
    body = _unpack_map(payload)
    version = body.get("triquad")
    if version is None:
        raise WireError("not a triquad message: it names no protocol version")
    if version != PROTOCOL_VERSION:
        raise ProtocolVersionError(
            f"protocol version {version!r} is not spoken here, only {PROTOCOL_VERSION}; "
            "use client and server of the same release"
        )
    if body.get("kind") != expected.__name__:
        raise WireError(f"expected a {expected.__name__}, got {body.get('kind')!r}")
    return _unpack_fields(expected.__name__, expected, body)


def pack_array(array: NDArray[np.generic]) -> dict[str, object]:
    """Return the msgpack form of an array, little endian and C order."""
    dtype = array.dtype.str
    if dtype not in _ITEM_BYTES:
        array = array.astype(array.dtype.newbyteorder("<"))
        dtype = array.dtype.str
        if dtype not in _ITEM_BYTES:
            names = sorted(_ITEM_BYTES)
            raise WireError(f"arrays of {array.dtype} do not travel; use one of {names}")
    return {"dtype": dtype, "shape": list(array.shape), "data": array.tobytes()}


def unpack_array(name: str, packed: object) -> NDArray[np.generic]:
    """Return the array of a msgpack form; read-only, sharing the message's bytes.

    Raises:
        WireError: the form is not complete or its sizes contradict each other. Nothing is
            allocated for a shape that the bytes do not fill.
    """
    if not isinstance(packed, dict) or packed.keys() != _ARRAY_KEYS:
        raise WireError(f"{name}: expected an array with dtype, shape and data")
    dtype, shape, data = packed["dtype"], packed["shape"], packed["data"]
    if not isinstance(dtype, str) or dtype not in _ITEM_BYTES:
        raise WireError(f"{name}: dtype {dtype!r} is not one of {sorted(_ITEM_BYTES)}")
    if not isinstance(shape, list) or len(shape) > _MAX_DIMENSIONS:
        raise WireError(f"{name}: shape {shape!r} is not a list of at most {_MAX_DIMENSIONS} sizes")
    items = 1  # but for sizes of zero: numpy does not form shapes beyond 64 bits, however empty
    for size in shape:
        if type(size) is not int or not 0 <= size < _MAX_SIZE:
            raise WireError(f"{name}: shape {shape!r} has a size that is not a count")
        items *= size or 1
    if items >= _MAX_SIZE:
        raise WireError(f"{name}: shape {shape!r} has a size that is not a count")
    if not isinstance(data, bytes) or math.prod(shape) * _ITEM_BYTES[dtype] != len(data):
        raise WireError(f"{name}: shape {shape!r} of {dtype} does not fill its data")
    return np.frombuffer(data, dtype).reshape(shape)


def check_structure(payload: bytes, max_objects: int = MAX_OBJECTS) -> None:
    """Refuse a msgpack object that is incomplete, too deep, or made of too many objects.

    Raises:
        WireError: the text says which.
    """
    at, objects = 0, 1  # as many as the headers so far announce
    missing, around = 1, [0]  # objects still to come, in the innermost one and in those around it
    while missing or len(around) > 1:
        if not missing:
            missing = around.pop()
            continue
        if at >= len(payload):
            raise WireError("not a triquad message: it is incomplete")
        missing -= 1
        size = _SIZES[payload[at]]
        if size:
            at += size
            continue
        at, children = _header(payload, at)
        objects += children
        if objects > max_objects:
            raise WireError(f"not a triquad message: more than {max_objects} objects")
        if children:
            around.append(missing)
            missing = children
        if len(around) > _MAX_DEPTH:
            raise WireError(f"not a triquad message: nested more than {_MAX_DEPTH} deep")
    if at != len(payload):
        raise WireError("not a triquad message: it is incomplete, or something follows it")


def binary_offsets(payload: bytes) -> Iterator[range]:
    """Yield where the bytes of each binary lie in a valid msgpack object, in their order."""
    at, objects = 0, 1
    while objects:
        code = payload[at]
        end, children = _header(payload, at)
        if 0xC4 <= code <= 0xC6:
            yield range(at + 1 + _LENGTH_BYTES[code], end)
        at, objects = end, objects - 1 + children


def _unpack_map(payload: bytes) -> dict[str, object]:
    if len(payload) > MAX_MESSAGE_BYTES:
        raise WireError(f"message of {len(payload)} bytes exceeds {MAX_MESSAGE_BYTES}")
    check_structure(payload)
    try:
        body = msgpack.unpackb(
            payload,
            max_str_len=_MAX_WIRE_STRING_BYTES,
            max_array_len=_MAX_ITEMS,
            max_map_len=_MAX_ITEMS,
        )
    except (ValueError, msgpack.exceptions.UnpackException) as error:
        raise WireError(f"not a triquad message: {error}") from error
    if not isinstance(body, dict):
        raise WireError(f"not a triquad message: a {type(body).__name__}, not a map")
    return body


def _header(payload: bytes, at: int) -> tuple[int, int]:
    """Return where the next header is, and how many objects the one at ``at`` announces."""
    code = payload[at]
    if _SIZES[code]:
        return at + _SIZES[code], 0
    at += 1
    if code <= 0x8F:
        return at, 2 * (code & 0x0F)
    if code <= 0x9F:
        return at, code & 0x0F
    if code in _LENGTH_BYTES:
        size = _LENGTH_BYTES[code]
        return at + size + int.from_bytes(payload[at : at + size], "big"), 0
    if code in _COUNT_BYTES:
        size = _COUNT_BYTES[code]
        count = int.from_bytes(payload[at : at + size], "big")
        return at + size, count if code <= 0xDD else 2 * count
    raise WireError(f"not a triquad message: type {code:#x} does not occur in one")


@dataclass(frozen=True)
class Form:
    """The encoding of a field's values. Both take the field's name, for errors, and a value."""

    pack: Callable[[str, Any], object]
    unpack: Callable[[str, object], Any]


def _form(annotation: Any) -> Form:
    spec = _array_spec(annotation)
    if spec is not None:
        return _array_form(spec)
    annotation = _plain(annotation)
    if isinstance(annotation, type) and issubclass(annotation, Message):
        return _message_form(annotation)
    origin = get_origin(annotation)
    if origin in (types.UnionType, typing.Union):
        (inner,) = (arg for arg in get_args(annotation) if arg is not type(None))
        return _optional_form(_form(inner))
    if origin is dict:
        key_type, item = get_args(annotation)
        return _map_form(_plain(key_type), _form(item))
    scalar = functools.partial(_scalar, annotation)
    return Form(scalar, scalar)


def _array_form(spec: ArraySpec) -> Form:
    def pack(name: str, array: Any) -> object:
        if not isinstance(array, np.ndarray):
            raise WireError(f"{name}: expected an array, got {type(array).__name__}")
        spec.check(name, array)
        return pack_array(array)

    def unpack(name: str, packed: object) -> NDArray[np.generic]:
        array = unpack_array(name, packed)
        spec.check(name, array)
        return array

    return Form(pack, unpack)


def _message_form(kind: type[Message]) -> Form:
    def pack(name: str, message: Any) -> object:
        if not isinstance(message, kind):
            raise WireError(f"{name}: expected {kind.__name__}, got {message!r}")
        return _pack_fields(name, message)

    def unpack(name: str, body: object) -> Message:
        if not isinstance(body, dict):
            raise WireError(f"{name}: expected a map with {', '.join(kind.annotations())}")
        return _unpack_fields(name, kind, body)

    return Form(pack, unpack)


def _optional_form(form: Form) -> Form:
    def pack(name: str, value: Any) -> object:
        return None if value is None else form.pack(name, value)

    def unpack(name: str, value: object) -> Any:
        return None if value is None else form.unpack(name, value)

    return Form(pack, unpack)


def _map_form(key_type: Any, form: Form) -> Form:
    def each(name: str, entries: Any, by: Callable[[str, Any], Any]) -> dict[Any, Any]:
        if not isinstance(entries, dict):
            raise WireError(f"{name}: expected dict, got {type(entries).__name__}")
        return {
            _scalar(key_type, f"{name} key", key): by(f"{name}[{key!r}]", entry)
            for key, entry in entries.items()
        }

    return Form(
        lambda name, entries: each(name, entries, form.pack),
        lambda name, entries: each(name, entries, form.unpack),
    )


def _pack_fields(name: str, message: Message) -> dict[str, object]:
    return {
        field: form.pack(f"{name}.{field}", getattr(message, field))
        for field, form in message.forms().items()
    }


def _unpack_fields(name: str, kind: type[MessageT], body: Mapping[str, object]) -> MessageT:
    fields = {}
    for field, form in kind.forms().items():
        if field in body:
            fields[field] = form.unpack(f"{name}.{field}", body[field])
        elif not hasattr(kind, field):  # without a default, for those who speak as before it came
            raise WireError(f"{name}.{field}: missing")
    return kind(**fields)


def _array_spec(annotation: Any) -> ArraySpec | None:
    for extra in getattr(annotation, "__metadata__", ()):
        if isinstance(extra, ArraySpec):
            return extra
    return None


def _plain(annotation: Any) -> Any:
    """Return the type in an annotation, without its metadata."""
    return annotation.__origin__ if hasattr(annotation, "__metadata__") else annotation


def _scalar(annotation: Any, name: str, value: object) -> Any:
    """Return ``value`` where it is exactly an ``annotation`` (an int also serves as a float)."""
    if annotation is float and type(value) is int:
        return float(value)
    if type(value) is not annotation:
        wanted = getattr(annotation, "__name__", str(annotation))
        raise WireError(f"{name}: expected {wanted}, got {type(value).__name__}")
    if annotation is int and not -(2**63) <= typing.cast("int", value) < 2**63:
        raise WireError(f"{name}: {value} does not fit 64 bits")
    return value
