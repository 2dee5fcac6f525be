"""Splits the loops of compiled code over the cores; kernels hold no Python lock."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

THREADS = max(1, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1)
"""Threads that share the work: one per core that this process may use."""

_POOL = ThreadPoolExecutor(THREADS, thread_name_prefix="triquad-kernel")
_MIN_SHARE = 512
"""Points below which splitting work between threads costs more than it gains."""


def split(count: int, work: Callable[[int, int], None]) -> None:
    """Run ``work(first, last)`` over ``range(count)``, in parallel where it is worth it."""
    parts = min(THREADS, max(1, count // _MIN_SHARE))
    bounds = [-(-count * part // parts) for part in range(parts + 1)]
    others = [_POOL.submit(work, bounds[i], bounds[i + 1]) for i in range(1, parts)]
    work(bounds[0], bounds[1])
    for other in others:
        other.result()
