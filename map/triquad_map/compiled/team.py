"""Splits the loops of compiled code over the cores; kernels hold no Python lock."""

import contextlib
import os
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait

THREADS = max(1, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1)
"""Threads that share the work: one per core that this process may use."""

_MIN_SHARE = 2048
"""Points of a field below which splitting work costs more than it gains."""


class Team:
    """Threads that share work with the caller. Who makes a team closes it."""

    def __init__(self, name: str, niceness: int = 0) -> None:
        """Threads start with the first work; for ``niceness`` see :func:`lower_priority`."""
        self._pool = ThreadPoolExecutor(
            THREADS, thread_name_prefix=name, initializer=lower_priority, initargs=(niceness,)
        )

    def close(self) -> None:
        """End the threads once their work is done; later work is left to the caller."""
        self._pool.shutdown()

    def each(self, work: Callable[[int], None]) -> None:
        """Run ``work(part)`` for every part of ``range(THREADS)``, at the same time."""
        self._run(work, THREADS)

    def split(self, count: int, work: Callable[[int, int], None], least: int = _MIN_SHARE) -> None:
        """Run ``work(first, last)`` over ``range(count)``, in parallel where it is worth it.

        ``least`` is how many a thread is given at least.
        """
        parts = min(THREADS, max(1, count // least))
        self._run(lambda part: work(*share(count, part, parts)), parts)

    @contextlib.contextmanager
    def beside(self) -> Iterator[Callable[[Callable[[], None]], None]]:
        """Run work beside the caller: each that is handed over has ended when the context does."""
        handed_over: list[Future[None]] = []

        def hand_over(work: Callable[[], None]) -> None:
            try:
                handed_over.append(self._pool.submit(work))
            except RuntimeError:  # closed, or the program ends
                work()

        try:
            yield hand_over
        finally:
            wait(handed_over)
        for work in handed_over:
            work.result()

    def _run(self, work: Callable[[int], None], parts: int) -> None:
        others: list[Future[None]] = []
        try:
            for part in range(1, parts):
                others.append(self._pool.submit(work, part))
        except RuntimeError:  # closed, or the program ends
            for part in range(1, parts):
                work(part)
        try:
            work(0)
        finally:
            wait(others)  # whatever happens, nobody goes on with what the caller has left
        for other in others:
            other.result()


def share(count: int, part: int, parts: int = THREADS) -> tuple[int, int]:
    """Where a part of ``range(count)`` begins and ends."""
    return -(-count * part // parts), -(-count * (part + 1) // parts)


def lower_priority(niceness: int) -> None:
    """Have the calling thread leave the cores to threads of less ``niceness``, 0 being the least.

    Where the system does not know priorities of single threads, nothing happens.
    """
    if niceness and sys.platform == "linux":
        with contextlib.suppress(OSError):
            thread = threading.get_native_id()
            nice = os.getpriority(os.PRIO_PROCESS, thread) + niceness
            os.setpriority(os.PRIO_PROCESS, thread, nice)
