"""How soon the system lets a thread compute, beside those for which somebody waits."""

import contextlib
import ctypes
import os
import platform
import sys
import threading

_SYS_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}
_SCHED_BATCH = 3
_SLICE_NS = 20_000_000
"""For so long a thread may compute once it has a core: with a longer turn than the 3 ms of others,
it leaves the core as soon as one of these wakes up, and not at the end of its turn. Linux 6.12 and
later know this, others ignore it."""


class _Attributes(ctypes.Structure):
    """``struct sched_attr`` of sched_setattr(2)."""

    _fields_ = (
        ("size", ctypes.c_uint32),
        ("policy", ctypes.c_uint32),
        ("flags", ctypes.c_uint64),
        ("nice", ctypes.c_int32),
        ("priority", ctypes.c_uint32),
        ("runtime", ctypes.c_uint64),
        ("deadline", ctypes.c_uint64),
        ("period", ctypes.c_uint64),
    )


def lower_priority(niceness: int) -> None:
    """Have the calling thread leave the cores to threads of less ``niceness``, 0 being the least.

    It is that beyond the process's, whoever started the thread. Where the system does not know
    priorities of single threads, nothing happens.
    """
    if niceness and sys.platform == "linux":
        # Not what the thread has: it may have been started by one that was lowered itself.
        nice = os.getpriority(os.PRIO_PROCESS, os.getpid()) + niceness
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), nice)
        _take_long_turns(nice)


def _take_long_turns(nice: int) -> None:
    """Have the calling thread, of this niceness, compute in few long turns, if the system can."""
    call = _SYS_SCHED_SETATTR.get(platform.machine())
    if call is None:
        return
    wanted = _Attributes(
        size=ctypes.sizeof(_Attributes), policy=_SCHED_BATCH, nice=nice, runtime=_SLICE_NS
    )
    this_thread, no_flags = ctypes.c_long(0), ctypes.c_long(0)
    with contextlib.suppress(AttributeError):  # a library without syscall(2)
        ctypes.CDLL(None).syscall(ctypes.c_long(call), this_thread, ctypes.byref(wanted), no_flags)
