"""Messages, encoded, decoded and moved by generic functions that the annotations of fields drive.

A message is a msgpack map that has ``triquad`` (the protocol version), ``kind`` (the name of
its class) and its fields. The places in one can be moved: from where a user's coordinates count to
where a map's do. The messages themselves are in :mod:`triquad_format.wire.messages`;
``docs/wire-protocol.md`` is the specification.
"""

import dataclasses
import functools
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar, get_args, get_origin

import msgpack
import numpy as np

from triquad_format.errors import ProtocolVersionError, WireError
from triquad_format.records.arrays import Doubles
from triquad_format.records.pose import moved_pose
from triquad_format.wire.packing import ArraySpec, pack_array, unpack_array, unpacked

PROTOCOL_VERSION = 1
MAX_MESSAGE_BYTES = 256 * 2**20
# To begin with: a refusal for want of memory must not want 256 KiB.
_BUFFER_BYTES = 4096

PLACE = "a place"
"""Marks a field's annotation: points [3] or [N, 3], or a pose [4, 4], of the map frame."""

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
    key: "Form | None" = None  # of a map
    item: "Form | None" = None  # of a map or a list
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
        """Return a number or a text, which travel as they are, or a list or map with its items."""
        if self.item is None:
            return _scalar(self.scalar, name, value)
        if self.key is None:
            if not isinstance(value, list | tuple):
                raise WireError(f"{name}: expected list, got {type(value).__name__}")
            item_way = way(self.item)
            return tuple(item_way(f"{name}[{at}]", item) for at, item in enumerate(value))
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
    if get_origin(annotation) is tuple:
        return Form(item=_form(choices[0]))
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


def moved(message: MessageT, by: Doubles) -> MessageT:
    """Return the message with all places in it, those of messages within it too, ``by`` [3] off."""
    return _moved(message, by) if by.any() else message


def known_origin(origin: Doubles | None) -> Doubles:
    """Return an origin [3] that a message may leave out: then it is 0 0 0."""
    return np.zeros(3) if origin is None else origin


def asked_from(origin: Doubles, answer: Callable[[Any], MessageT], question: Message) -> MessageT:
    """Return the answer of a map that counts from an ``origin`` [3] of the question's coordinates.

    ``answer`` answers questions about that map, and both are in its own coordinates.
    """
    return moved(answer(moved(question, -origin)), origin)


def _moved(message: MessageT, by: Doubles) -> MessageT:
    forms = message.forms().items()
    there = {name: _moved_value(form, getattr(message, name), by) for name, form in forms}
    return dataclasses.replace(message, **there)  # type: ignore[type-var]


def _moved_value(form: Form, value: Any, by: Doubles) -> Any:
    if isinstance(value, Message):
        return _moved(value, by)
    if isinstance(value, dict) and form.item is not None:
        return {key: _moved_value(form.item, item, by) for key, item in value.items()}
    if PLACE not in form.extras or value is None:
        return value
    return moved_pose(value, by) if value.shape == (4, 4) else np.asarray(value + by)
