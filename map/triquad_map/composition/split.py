"""How work over many points is shared among threads, or cut into pieces that fit into memory."""

from collections.abc import Callable
from typing import Protocol

Work = Callable[[int, int], None]
"""Does the part ``range(first, last)`` of some work."""


class Split(Protocol):
    """Runs work over ``range(count)``, in parts at the same time where it is worth it."""

    def __call__(self, count: int, work: Work, least: int = ...) -> None:
        """``least`` is how many a part has at least, where the default is too many."""


def in_one(count: int, work: Work, least: int = 0) -> None:  # noqa: ARG001
    """A :class:`Split` for the caller's thread alone."""
    work(0, count)
