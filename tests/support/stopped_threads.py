"""Threads of another process that hang: a debugger's system calls stop them, and only them."""

import ctypes
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

_SEIZE, _INTERRUPT, _DETACH = 0x4206, 0x4207, 17  # of ptrace(2)
_ALL = 0x40000000  # __WALL of waitpid(2)

_libc = ctypes.CDLL(None, use_errno=True)


@contextmanager
def stopped(threads: Iterable[int]) -> Iterator[None]:
    """The threads of these ids do nothing while the context is open.

    Raises:
        OSError: the system does not let them be stopped.
    """
    held: list[int] = []
    try:
        for thread in threads:
            _ptrace(_SEIZE, thread)
            _ptrace(_INTERRUPT, thread)
            os.waitpid(thread, _ALL)
            held.append(thread)
        yield
    finally:
        for thread in held:
            _ptrace(_DETACH, thread)


def _ptrace(request: int, thread: int) -> None:
    if _libc.ptrace(request, thread, None, None) == -1:
        number = ctypes.get_errno()
        raise OSError(number, f"ptrace: {os.strerror(number)}")
