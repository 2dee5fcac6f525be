"""The bounds of the fields of replies, and the check that the client makes of a reply.

A field's annotation names its bounds next to its type, so that a message says all of it in one
place. A server may be wrong or hostile: what does not answer the question is refused whole.
"""

import functools
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol, get_args, get_origin

import numpy as np

from triquad_format.errors import WireError
from triquad_format.wire.codec import Message

MAX_COUNT = 2**53
"""The largest epoch or count: doubles represent all whole numbers up to here."""

_ROUNDING = 1e-4
"""The share by which a number may exceed what was asked for: single precision rounds."""

_RIGID_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Exchange:
    """A question and the reply to it: what the value of a field is compared with."""

    question: Message
    around: tuple[Message, ...]  # the messages that the field is in, innermost first

    def number(self, bound: float | str) -> float:
        """Return a bound, which may be a number of the question, or the negative of one."""
        if not isinstance(bound, str):
            return bound
        asked = float(getattr(self.question, bound.removeprefix("-"))) * (1 + _ROUNDING)
        return -asked if bound.startswith("-") else asked

    def rows(self, field: str) -> int:
        """Return the rows of an array that stands next to the field, or around it."""
        holder = next(message for message in self.around if field in message.annotations())
        return len(getattr(holder, field))


class Check(Protocol):
    """A bound of a field; an annotation may have several."""

    def problem(self, value: Any, exchange: Exchange) -> str | None:
        """Return what is wrong with a value, or ``None``."""


@dataclass(frozen=True)
class Within:
    """A finite number, or an array of such, from ``least`` to ``most``.

    A bound is a number, or the name of a positive number of the question, maybe after ``-``.
    """

    least: float | str = -math.inf
    most: float | str = math.inf
    nan: bool = False  # some may be no numbers

    def problem(self, value: Any, exchange: Exchange) -> str | None:
        """Return what is out of bounds, or not finite."""
        if isinstance(value, np.ndarray):
            if value.size == 0:
                return None
            low, high = (np.fmin, np.fmax) if self.nan else (np.minimum, np.maximum)
            # Whole numbers as they are: as doubles, those beyond MAX_COUNT could round down to it.
            ends = [low.reduce(value, axis=None).item(), high.reduce(value, axis=None).item()]
        else:
            ends = [value]
        if self.nan and math.isnan(ends[0]):
            return None
        least, most = exchange.number(self.least), exchange.number(self.most)
        for end in ends:
            if not math.isfinite(end):
                return f"{end} is not finite"
            if not least <= end <= most:
                return f"{end:g} is not in [{least:g}, {most:g}]"
        return None


@dataclass(frozen=True)
class Text:
    """A text of at most ``most`` characters, which may have to be of some form."""

    most: int
    form: str = ""  # a regular expression

    def problem(self, value: Any, exchange: Exchange) -> str | None:  # noqa: ARG002
        """Return what is too long, or of another form."""
        if len(value) > self.most:
            return f"{len(value)} characters are more than {self.most}"
        if self.form and not re.fullmatch(self.form, value):
            return f"{value[:80]!r} is not of the form {self.form}"
        return None


@dataclass(frozen=True)
class AskedBy:
    """The bound of as many rows as an array of the question has, or bytes as a number says."""

    field: str

    def problem(self, value: Any, exchange: Exchange) -> str | None:
        """Return how the numbers differ, or ``None``."""
        asked = getattr(exchange.question, self.field)
        count = asked if isinstance(asked, int) else len(asked)
        return None if len(value) == count else f"{len(value)} came for {count}"


@dataclass(frozen=True)
class AtMostAsked:
    """The bound of at most as many rows as a number of the question says."""

    field: str

    def problem(self, value: Any, exchange: Exchange) -> str | None:
        """Return how there are more rows, or ``None``."""
        most: int = getattr(exchange.question, self.field)
        return None if len(value) <= most else f"{len(value)} came, and {most} were asked for"


@dataclass(frozen=True)
class ShapeAskedBy:
    """An array whose sizes are those that an array of the question has as values."""

    field: str

    def problem(self, value: Any, exchange: Exchange) -> str | None:
        """Return how the sizes differ, or ``None``."""
        shape, asked = list(value.shape), getattr(exchange.question, self.field).tolist()
        return None if shape == asked else f"{shape} came for {asked}"


@dataclass(frozen=True)
class SameAsAsked:
    """The same as in the question, which may leave it to the server with 0."""

    field: str

    def problem(self, value: Any, exchange: Exchange) -> str | None:
        """Return how the value differs, or ``None``."""
        asked = getattr(exchange.question, self.field, 0)
        return f"{value} came for {asked}" if asked and value != asked else None


@dataclass(frozen=True)
class RowsOf:
    """The bound of as many rows as another array of the reply has, and ``more``."""

    field: str
    more: int = 0

    def problem(self, value: Any, exchange: Exchange) -> str | None:
        """Return how the numbers differ, or ``None``."""
        count = exchange.rows(self.field) + self.more
        return None if len(value) == count else f"{len(value)} rows do not go with {count}"


@dataclass(frozen=True)
class PartsOf:
    """The numbers of rows that parts have of another array of the reply: all of its rows."""

    field: str

    def problem(self, value: Any, exchange: Exchange) -> str | None:
        """Return how the sum differs, or ``None``."""
        parts, count = int(value.sum()), exchange.rows(self.field)
        return None if parts == count else f"parts of {parts} rows do not go with {count}"


@dataclass(frozen=True)
class RigidPose:
    """A rotation and a translation."""

    def problem(self, value: Any, exchange: Exchange) -> str | None:
        """Return what is wrong where it is neither."""
        if problem := Within(-1e12, 1e12).problem(value, exchange):
            return problem
        rotation = np.clip(value[:3, :3], -2, 2)
        off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        is_proper = np.linalg.det(rotation) > 0 and (value[3] == (0, 0, 0, 1)).all()
        return None if is_proper and off <= _RIGID_TOLERANCE else "it is no rigid pose"


def check_answers(question: Message, reply: Message) -> None:
    """Raise :class:`WireError` where a reply is no answer to the question.

    The text names the field and what is wrong with it.
    """
    for name, problem in _problems(reply, question, ()):
        raise WireError(f"{name}: {problem}")


def _problems(
    message: Message, question: Message, outer: tuple[Message, ...]
) -> Iterator[tuple[str, str]]:
    exchange = Exchange(question, (message, *outer))
    kind: Any = type(message)  # mypy takes no class of messages for hashable
    for field, bounds in _bounds_of(kind).items():
        yield from bounds.problems(f"{kind.__name__}.{field}", getattr(message, field), exchange)


@dataclass(frozen=True)
class _Bounds:
    """The bounds of a field's values; of a map, those of its keys and its items."""

    checks: tuple[Check, ...] = ()
    key: "_Bounds | None" = None
    item: "_Bounds | None" = None

    def problems(self, name: str, value: Any, exchange: Exchange) -> Iterator[tuple[str, str]]:
        """Yield where in the value of the field ``name`` something is wrong, and what."""
        if value is None:
            return
        if isinstance(value, Message):
            yield from _problems(value, exchange.question, exchange.around)
        elif self.key is not None and self.item is not None:
            for key, entry in value.items():
                yield from self.key.problems(f"{name} key", key, exchange)
                yield from self.item.problems(f"{name}[{key!r}]", entry, exchange)
        else:
            for check in self.checks:
                problem = check.problem(value, exchange)
                if problem is not None:
                    yield name, problem


@functools.cache
def _bounds_of(kind: type[Any]) -> dict[str, _Bounds]:
    """Return the bounds of a message's fields: to find them takes longer than to check them."""
    return {field: _bounds(annotation) for field, annotation in kind.annotations().items()}


def _bounds(annotation: Any) -> _Bounds:
    if get_origin(annotation) is dict:
        key, item = get_args(annotation)
        return _Bounds(key=_bounds(key), item=_bounds(item))
    return _Bounds(_checks(annotation))


def _checks(annotation: Any) -> tuple[Check, ...]:
    """Return the checks in an annotation, that of a field which may be ``None`` included."""
    if hasattr(annotation, "__metadata__"):
        return tuple(extra for extra in annotation.__metadata__ if hasattr(extra, "problem"))
    return tuple(check for choice in get_args(annotation) for check in _checks(choice))
