"""Splits the loops of compiled code over the cores, by threads of a priority; kernels run without
Python's lock.
"""

import contextlib
import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Protocol, TypeVar

_thread = threading.local()


def lower_priority(niceness: int) -> None:
    """Have the calling thread leave the cores to threads of less ``niceness``, 0 being the least.

    The niceness is added to that of the process, whichever thread started this one. Where the
    system does not know priorities of single threads, nothing happens.
    """
    _thread.niceness = niceness
    if niceness and sys.platform == "linux":
        # Not what the thread has: it may have been started by one that was lowered itself.
        nice = os.getpriority(os.PRIO_PROCESS, os.getpid()) + niceness
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), nice)


def is_urgent() -> bool:
    """Return whether the calling thread has the priority of the process, not a lower one."""
    return getattr(_thread, "niceness", 0) == 0


def _threads() -> int:
    """Return one thread for each core, or as many as the environment allows, if that is fewer."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    given = os.environ.get("TRIQUAD_THREADS", "")
    return max(1, min(cores, int(given)) if given.isdecimal() else cores)


THREADS = _threads()
"""Threads that share the work: one per core that this process may use, unless fewer are set."""

MIN_SHARE = 2048
"""Points of a field below which splitting work costs more than it gains."""


Result = TypeVar("Result")

Work = Callable[[int, int], None]
"""Does the part ``range(first, last)`` of some work."""


class Split(Protocol):
    """Runs work over ``range(count)``, in parts at the same time where it is worth it."""

    def __call__(self, count: int, work: Work, least: int = ...) -> None:
        """Run work; ``least`` is how many a part has at least, where the default is too many."""


def in_one(count: int, work: Work, least: int = 0) -> None:  # noqa: ARG001
    """Do all work on the caller's thread alone: a :class:`Split`."""
    work(0, count)


def _do(work: Callable[[], None], done: "Future[None]") -> None:
    """Do some work, unless the caller has taken it back."""
    if not done.set_running_or_notify_cancel():
        return
    try:
        work()
    except BaseException as error:
        done.set_exception(error)
    else:
        done.set_result(None)


def _finish(work: Callable[[], None], done: "Future[None]") -> None:
    """Wait for work that a thread has begun, or do it."""
    if done.cancel():
        work()
    else:
        done.result()


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

    def along(self, own: Callable[[], Result], count: int, work: Work, least: int) -> Result:
        """Run ``own`` on the caller's thread and ``work`` over ``range(count)`` on the others.

        The caller joins these when its own is done; ``least`` is how many a part has at least.
        """
        results: list[Result] = []
        parts = max(1, count // least)

        def do(part: int) -> None:
            if part == 0:
                results.append(own())
            else:
                work(*share(count, part - 1, parts))

        self._run(do, 1 + parts)
        return results[0]

    def _run(self, work: Callable[[int], None], parts: int) -> None:
        with contextlib.ExitStack() as rest:  # nobody goes on with it later, whatever happens
            for part in range(1, parts):
                piece, done = partial(work, part), Future[None]()
                with contextlib.suppress(RuntimeError):  # closed, or no thread can be started
                    self._pool.submit(_do, piece, done)
                rest.callback(_finish, piece, done)
            work(0)


def share(count: int, part: int, parts: int = THREADS) -> tuple[int, int]:
    """Return where a part of ``range(count)`` begins and ends."""
    return -(-count * part // parts), -(-count * (part + 1) // parts)
