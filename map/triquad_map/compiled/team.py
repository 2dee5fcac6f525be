"""Splits the loops of compiled code over the cores, by threads of a priority; kernels run without
Python's lock.
"""

import contextlib
import os
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import partial
from typing import Protocol, TypeVar


def lower_priority(niceness: int) -> None:
    """Have the calling thread leave the cores to threads of less ``niceness``, 0 being the least.

    The niceness is added to that of the process, whichever thread started this one. Where the
    system does not know priorities of single threads, nothing happens.
    """
    if niceness and sys.platform == "linux":
        # Not what the thread has: it may have been started by one that was lowered itself.
        nice = os.getpriority(os.PRIO_PROCESS, os.getpid()) + niceness
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), nice)


THREADS = max(1, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1)
"""Threads that share the work: one per core that this process may use."""

MineT = TypeVar("MineT")
OtherT = TypeVar("OtherT")

MIN_SHARE = 2048
"""Points of a field below which splitting work costs more than it gains."""


Work = Callable[[int, int], None]
"""Does the part ``range(first, last)`` of some work."""


class Split(Protocol):
    """Runs work over ``range(count)``, in parts at the same time where it is worth it."""

    def __call__(self, count: int, work: Work, least: int = ...) -> None:
        """Run work; ``least`` is how many a part has at least, where the default is too many."""


def in_one(count: int, work: Work, least: int = 0) -> None:  # noqa: ARG001
    """Do all work on the caller's thread alone: a :class:`Split`."""
    work(0, count)


class _Part:
    """A part of some work, done by a thread or by the caller: by the first that is free."""

    def __init__(self, work: Callable[[], None]) -> None:
        self._work = work
        self._begun = threading.Lock()
        self.done: Future[None] = Future()

    def do(self) -> None:
        """Do it, unless somebody has begun."""
        if not self._begun.acquire(blocking=False):
            return
        try:
            self._work()
        except BaseException as error:
            self.done.set_exception(error)
        else:
            self.done.set_result(None)


class Team:
    """Threads that share work with the caller. Who makes a team closes it.

    What no thread has begun, since all have other work, or none could be started, or the team is
    closed, the caller does.
    """

    def __init__(self, name: str, niceness: int = 0) -> None:
        """Start threads with the first work; ``niceness`` is as of :func:`lower_priority`."""
        self._pool = ThreadPoolExecutor(
            max(1, THREADS - 1),  # the caller is the other one
            thread_name_prefix=name,
            initializer=lower_priority,
            initargs=(niceness,),
        )

    def close(self) -> None:
        """End the threads once their work is done."""
        self._pool.shutdown()

    def each(self, work: Callable[[int], None]) -> None:
        """Run ``work(part)`` for every part of ``range(THREADS)``, at the same time."""
        self._run(work, THREADS)

    def split(self, count: int, work: Work, least: int = MIN_SHARE) -> None:
        """Run ``work(first, last)`` over ``range(count)``, in parallel where it is worth it.

        ``least`` is how many a thread is given at least.
        """
        parts = min(THREADS, max(1, count // least))
        if parts == 1:
            work(0, count)
        else:
            self._run(lambda part: work(*share(count, part, parts)), parts)

    def both(self, mine: Callable[[], MineT], other: Callable[[], OtherT]) -> tuple[MineT, OtherT]:
        """Return what two pieces of work return, done in parallel: the caller does ``mine``."""
        found: list[OtherT] = []
        part = self._offer(lambda: found.append(other()))
        try:
            result = mine()
        finally:
            _finish([part])
        part.done.result()
        return result, found[0]

    def _run(self, work: Callable[[int], None], parts: int) -> None:
        others = [self._offer(partial(work, part)) for part in range(1, parts)]
        try:
            work(0)
        finally:
            _finish(others)
        for other in others:
            other.done.result()

    def _offer(self, work: Callable[[], None]) -> _Part:
        """Let a thread do some work, if one comes to it before the caller."""
        part = _Part(work)
        with contextlib.suppress(RuntimeError):  # closed, or no thread can be started
            self._pool.submit(part.do)
        return part


def _finish(parts: Sequence[_Part]) -> None:
    """Let nobody go on with what the caller has left, whatever happens."""
    for part in parts:
        part.do()
    wait([part.done for part in parts])


def share(count: int, part: int, parts: int = THREADS) -> tuple[int, int]:
    """Return where a part of ``range(count)`` begins and ends."""
    return -(-count * part // parts), -(-count * (part + 1) // parts)
