"""The priority of a thread, compared with those for which somebody waits."""

import contextlib
import os
import sys
import threading


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
