"""The places in messages, moved: from where a user's coordinates count to where a map's do."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triquad_format.wire.codec import Form, Message, MessageT

Doubles = NDArray[np.float64]

PLACE = "a place"
"""Marks a field's annotation: points [3] or [N, 3], or a pose [4, 4], of the map frame."""


def moved(message: MessageT, by: Doubles) -> MessageT:
    """Return the message with all places in it, those of messages within it too, ``by`` [3] off."""
    return _moved(message, by) if by.any() else message


def moved_pose(pose: Doubles, by: Doubles) -> Doubles:
    """Return a pose [4, 4] whose position is ``by`` [3] off."""
    result: Doubles = pose.copy()
    result[:3, 3] += by
    return result


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
