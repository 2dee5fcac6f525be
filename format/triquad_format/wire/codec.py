"""Encoding of messages: one generic pair of functions, driven by the dataclasses' annotations.

A message is a msgpack map that has ``triquad`` (the protocol version), ``kind`` (the name of
its class) and its fields; an array is one of its dtype, shape and raw little-endian bytes. The
messages themselves are in :mod:`triquad_format.wire.messages`; ``docs/wire-protocol.md`` is the
specification.
"""

import dataclasses
import functools
import math
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar, get_args, get_origin

import msgpack
import numpy as np
from numpy.typing import NDArray

from triquad_format.errors import ProtocolVersionError, WireError
from triquad_format.wire.unpacking import unpacked

PROTOCOL_VERSION = 1
MAX_MESSAGE_BYTES = 256 * 2**20
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

MessageT = TypeVar("MessageT", bound="Message")
ReplyT = TypeVar("ReplyT", bound="Message")


class Message:
    """Base of all wire messages; subclasses are frozen dataclasses."""

    @classmethod
    @functools.cache
    def forms(cls) -> dict[str, "Form"]:
        """Return how each field travels, by its name."""
        annotations = typing.get_type_hints(cls, include_extras=True)
        fields = dataclasses.fields(typing.cast(Any, cls))
        return {field.name: _form(annotations[field.name]) for field in fields}


class Request(Message, Generic[ReplyT]):
    """A message that a server answers; its class says what with, and on which key it travels.

    Bulky ones go in the ``background``: a reply has the priority of its request, and a slow reader
    of large replies must not delay the distance queries of others.
    """

    operation: ClassVar[str]  # of triquad_format.wire.keys
    reply: ClassVar[type[Message]]
    background: ClassVar[bool]

    def __init_subclass__(cls, *, operation: str, background: bool = False) -> None:
        super().__init_subclass__()
        (cls.reply,) = get_args(cls.__dict__["__orig_bases__"][0])
        cls.operation, cls.background = operation, background


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


def _unpack_map(payload: bytes) -> dict[str, object]:
    if len(payload) > MAX_MESSAGE_BYTES:
        raise WireError(f"message of {len(payload)} bytes exceeds {MAX_MESSAGE_BYTES}")
    try:
        body = unpacked(payload)
    except WireError as error:
        raise WireError(f"not a triquad message: {error}") from error
    if not isinstance(body, dict):
        raise WireError(f"not a triquad message: a {type(body).__name__}, not a map")
    return body


@dataclass(frozen=True)
class Form:
    """The encoding of a field's values, by its annotation."""

    scalar: type | None = None
    array: ArraySpec | None = None
    message: type[Message] | None = None
    key: "Form | None" = None  # of a map, and the form of its items
    item: "Form | None" = None
    optional: bool = False
    extras: tuple[object, ...] = ()  # what else the annotation has, such as bounds

    def pack(self, name: str, value: Any) -> object:
        """Return a value as it travels; ``name`` is the field's, for errors."""
        if value is None and self.optional:
            return None
        if self.array is not None:
            if not isinstance(value, np.ndarray):
                raise WireError(f"{name}: expected an array, got {type(value).__name__}")
            self.array.check(name, value)
            return pack_array(value)
        if self.message is not None:
            if not isinstance(value, self.message):
                raise WireError(f"{name}: expected {self.message.__name__}, got {value!r}")
            return _pack_fields(name, value)
        return self._plain(name, value, lambda form: form.pack)

    def unpack(self, name: str, value: object) -> Any:
        """Return the value that travelled; ``name`` is the field's, for errors."""
        if value is None and self.optional:
            return None
        if self.array is not None:
            array = unpack_array(name, value)
            self.array.check(name, array)
            return array
        if self.message is not None:
            if not isinstance(value, dict):
                fields = ", ".join(self.message.forms())
                raise WireError(f"{name}: expected a map with {fields}")
            return _unpack_fields(name, self.message, value)
        return self._plain(name, value, lambda form: form.unpack)

    def _plain(
        self, name: str, value: Any, way: Callable[["Form"], Callable[[str, Any], Any]]
    ) -> Any:
        """Return a number, a text or a map, which travel as they are but for a map's items."""
        if self.key is None or self.item is None:
            return _scalar(self.scalar, name, value)
        if not isinstance(value, dict):
            raise WireError(f"{name}: expected dict, got {type(value).__name__}")
        key_way, item_way = way(self.key), way(self.item)
        return {
            key_way(f"{name} key", key): item_way(f"{name}[{key!r}]", item)
            for key, item in value.items()
        }


def _form(annotation: Any) -> Form:
    """Return the form of an annotation, which may have metadata."""
    extras = getattr(annotation, "__metadata__", ())
    for extra in extras:
        if isinstance(extra, ArraySpec):
            return Form(array=extra, extras=extras)
    if extras:
        return dataclasses.replace(_form(annotation.__origin__), extras=extras)
    if isinstance(annotation, type) and issubclass(annotation, Message):
        return Form(message=annotation)
    choices = get_args(annotation)
    if get_origin(annotation) is dict:
        return Form(key=_form(choices[0]), item=_form(choices[1]))
    if get_origin(annotation) in (types.UnionType, typing.Union):
        (inner,) = (choice for choice in choices if choice is not type(None))
        return dataclasses.replace(_form(inner), optional=True)
    return Form(scalar=annotation)


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
