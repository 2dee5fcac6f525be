"""Splits the loops of compiled code over the cores; kernels hold no Python lock."""

import contextlib
import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

THREADS = max(1, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1)
"""Threads that share the work: one per core that this process may use."""

_MIN_SHARE = 2048
"""Points below which splitting work between threads costs more than it gains."""
_NICE = 10


class Team:
    """Threads that share work; those of a patient team leave the cores to whoever else wants them.

    Where the system does not know priorities of single threads, a patient team is like any other.
    """

    def __init__(self, name: str, patient: bool = False) -> None:
        self._patient = patient
        self._pool = ThreadPoolExecutor(
            THREADS,
            thread_name_prefix=name,
            initializer=_be_patient if patient else None,
        )

    def each(self, work: Callable[[int], None]) -> None:
        """Run ``work(part)`` for every part of ``range(THREADS)``, at the same time."""
        self._run(work, THREADS)

    def split(self, count: int, work: Callable[[int, int], None]) -> None:
        """Run ``work(first, last)`` over ``range(count)``, in parallel where it is worth it."""
        parts = min(THREADS, max(1, count // _MIN_SHARE))
        self._run(lambda part: work(*share(count, part, parts)), parts)

    def beside(self, work: Callable[[], None]) -> "Future[None]":
        """Run ``work()`` beside the caller, who waits for the result later."""
        return self._pool.submit(work)

    def _run(self, work: Callable[[int], None], parts: int) -> None:
        # The caller has other things to do at once: a patient team does all work itself.
        mine = 0 if self._patient else 1
        others = [self._pool.submit(work, part) for part in range(mine, parts)]
        if mine:
            work(0)
        for other in others:
            other.result()


def share(count: int, part: int, parts: int = THREADS) -> tuple[int, int]:
    """Where a part of ``range(count)`` begins and ends."""
    return -(-count * part // parts), -(-count * (part + 1) // parts)


def _be_patient() -> None:
    if hasattr(os, "setpriority"):
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)


TRAINING = Team("triquad-training", patient=True)
"""For what can wait: training."""

ANSWERS = Team("triquad-answers")
"""For what someone waits for: queries, and taking in scans."""
