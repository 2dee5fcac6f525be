"""The bounds of the fields of messages, and the check of what came over the network.

A field's annotation names its bounds next to its type, so that a message says all of it in one
place. Servers refuse a question that is out of bounds. A server may be wrong or hostile, too: what
does not answer the question is refused whole.
"""

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from triquad_format.errors import WireError
from triquad_format.records.pose import is_rigid
from triquad_format.wire.codec import Form, Message

MAX_COUNT = 2**53
"""The largest epoch or count: doubles represent all whole numbers up to here."""

_ROUNDING = 1e-4
"""The share by which a number may exceed what was asked for: single precision rounds."""


@dataclass(frozen=True)
class Exchange:
    """A question and the message that is checked: what the value of a field is compared with."""

    question: Message
    around: tuple[Message, ...]  # the messages that the field is in, innermost first

    def number(self, bound: float | str) -> float:
        """Return a bound, which may be a number of the question, or the negative of one."""
        if not isinstance(bound, str):
            return bound
        asked = float(getattr(self.question, bound.removeprefix("-"))) * (1 + _ROUNDING)
        return -asked if bound.startswith("-") else asked

    def other(self, field: str) -> Any:
        """Return the value of a field that stands next to the one that is checked, or around it."""
        holder = next(message for message in self.around if field in message.forms())
        return getattr(holder, field)


Bound: TypeAlias = Callable[[Any, Exchange], str | None]
"""Returns what is wrong with the value of a field, or ``None``; an annotation may have several."""


def within(
    least: float | str = -math.inf, most: float | str = math.inf, *, nan: bool = False
) -> Bound:
    """Bound a number, or an array of such: finite, from ``least`` to ``most``.

    These are numbers, or the name of a positive number of the question, maybe after ``-``. With
    ``nan``, some of an array may be no numbers.
    """

    def problem(value: Any, exchange: Exchange) -> str | None:
        ends = [value]
        if isinstance(value, np.ndarray):
            if value.size == 0:
                return None
            low, high = (np.fmin, np.fmax) if nan else (np.minimum, np.maximum)
            # Whole numbers as they are: as doubles, those beyond MAX_COUNT could round down to it.
            ends = [low.reduce(value, axis=None).item(), high.reduce(value, axis=None).item()]
        if nan and math.isnan(ends[0]):
            return None
        first, last = exchange.number(least), exchange.number(most)
        for end in ends:
            if not math.isfinite(end):
                return f"{end} is not finite"
            if not first <= end <= last:
                return f"{end:g} is not in [{first:g}, {last:g}]"
        return None

    return problem


def text(most: int, form: str = "") -> Bound:
    """Bound a text: at most ``most`` characters, maybe of a form, which is a regular expression."""

    def problem(value: str, _: Exchange) -> str | None:
        if len(value) > most:
            return f"{len(value)} characters are more than {most}"
        if form and not re.fullmatch(form, value):
            return f"{value[:80]!r} is not of the form {form}"
        return None

    return problem


def asked_by(field: str) -> Bound:
    """Bound rows to as many as an array of the question has, or bytes to as a number says."""

    def problem(value: Any, exchange: Exchange) -> str | None:
        asked = getattr(exchange.question, field)
        count = asked if isinstance(asked, int) else len(asked)
        return None if len(value) == count else f"{len(value)} came for {count}"

    return problem


def at_most_asked(field: str) -> Bound:
    """Bound rows to at most as many as a number of the question says."""

    def problem(value: Any, exchange: Exchange) -> str | None:
        most = getattr(exchange.question, field)
        return None if len(value) <= most else f"{len(value)} came, and {most} were asked for"

    return problem


def shape_asked_by(field: str) -> Bound:
    """Bound an array's sizes to the values of an array of the question."""

    def problem(value: Any, exchange: Exchange) -> str | None:
        shape, asked = list(value.shape), getattr(exchange.question, field).tolist()
        return None if shape == asked else f"{shape} came for {asked}"

    return problem


def same_as_asked(field: str, *, any_for: int | None = 0) -> Bound:
    """Bound a number to that of the question, which may leave it to the server with ``any_for``."""

    def problem(value: int, exchange: Exchange) -> str | None:
        asked = getattr(exchange.question, field, any_for)
        return f"{value} came for {asked}" if value != asked != any_for else None

    return problem


def rows_of(field: str, more: int = 0) -> Bound:
    """Bound rows to as many as another array of the message has, and ``more``."""

    def problem(value: Any, exchange: Exchange) -> str | None:
        count = len(exchange.other(field)) + more
        return None if len(value) == count else f"{len(value)} rows do not go with {count}"

    return problem


def parts_of(field: str) -> Bound:
    """Bound the numbers of rows that parts have of another array of the reply: all of its rows."""

    def problem(value: Any, exchange: Exchange) -> str | None:
        parts, count = int(value.sum()), len(exchange.other(field))
        return None if parts == count else f"parts of {parts} rows do not go with {count}"

    return problem


def rows(least: int, most: int) -> Bound:
    """Bound the number of rows of an array."""

    def problem(value: Any, _: Exchange) -> str | None:
        return None if least <= len(value) <= most else f"{len(value)} rows: use {least} to {most}"

    return problem


def corner_above(field: str) -> Bound:
    """Bound the corner of a box to lie nowhere below another one; both may be infinite."""

    def problem(value: Any, exchange: Exchange) -> str | None:
        low = exchange.other(field)
        return None if (low <= value).all() else f"not a box: from {low} to {value}"

    return problem


def rigid_pose() -> Bound:
    """Bound a matrix to a rotation and a translation."""
    small = within(-1e12, 1e12)

    def problem(value: Any, exchange: Exchange) -> str | None:
        wrong = None if is_rigid(value) else "it is no rigid pose"
        return small(value, exchange) or wrong

    return problem


def check_question(question: Message) -> None:
    """Raise :class:`WireError`, naming the field and its value, where it is out of bounds."""
    check_answers(question, question)


def check_answers(question: Message, reply: Message) -> None:
    """Raise :class:`WireError` where a reply is no answer to the question.

    The text names the field and what is wrong with it.
    """
    for name, problem in _problems(reply, question, ()):
        raise WireError(f"{name}: {problem}")


def _problems(
    message: Message, question: Message, outer: tuple[Message, ...]
) -> Iterator[tuple[str, str]]:
    """Yield which fields of a message have a problem, and what it is."""
    exchange = Exchange(question, (message, *outer))
    for field, form in message.forms().items():
        name = f"{type(message).__name__}.{field}"
        yield from _problems_of(form, name, getattr(message, field), exchange)


def _problems_of(
    form: Form, name: str, value: Any, exchange: Exchange
) -> Iterator[tuple[str, str]]:
    if value is None:
        return
    if isinstance(value, Message):
        yield from _problems(value, exchange.question, exchange.around)
    elif form.item is not None and form.key is None:
        for at, entry in enumerate(value):
            yield from _problems_of(form.item, f"{name}[{at}]", entry, exchange)
    elif form.key is not None and form.item is not None:
        for key, entry in value.items():
            yield from _problems_of(form.key, f"{name} key", key, exchange)
            yield from _problems_of(form.item, f"{name}[{key!r}]", entry, exchange)
    else:
        for extra in form.extras:
            if callable(extra) and (problem := extra(value, exchange)):
                yield name, problem
