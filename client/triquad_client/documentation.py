"""Documentation that the awaited classes take from the blocking ones."""

import inspect
from collections.abc import Callable
from typing import TypeVar

KindT = TypeVar("KindT", bound=type)


def documented_as(blocking: type) -> Callable[[KindT], KindT]:
    """Give each public method without a docstring that of the same method of ``blocking``."""

    def document(awaited: KindT) -> KindT:
        for name, method in vars(awaited).items():
            if not name.startswith("_") and inspect.isfunction(method) and method.__doc__ is None:
                method.__doc__ = getattr(blocking, name).__doc__
        return awaited

    return document
