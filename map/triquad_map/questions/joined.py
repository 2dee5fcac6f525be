"""Answers to consecutive points, put together."""

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    AnswerT = TypeVar("AnswerT", bound=DataclassInstance)


def joined(answers: "Sequence[AnswerT]") -> "AnswerT":
    """Answers to consecutive points as one: their arrays, and all else of the first."""
    if len(answers) == 1:
        return answers[0]
    columns: dict[str, Any] = {}
    for field in fields(answers[0]):
        parts = [getattr(answer, field.name) for answer in answers]
        if isinstance(parts[0], np.ndarray):
            columns[field.name] = np.concatenate(parts)
    return replace(answers[0], **columns)
