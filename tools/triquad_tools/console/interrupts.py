"""Handling of Ctrl-C, so that it ends a command wherever it is."""

import re
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_SWALLOW = re.compile(r"<frozen importlib|llvmlite.binding.executionengine\.py$")
"""Files whose code swallows exceptions or changes them."""

_AGAIN_S = 0.1

_raised = threading.Event()


@contextmanager
def no_interrupt_lost() -> Iterator[None]:
    """Let SIGINT raise ``KeyboardInterrupt`` later where it would be swallowed, else at once.

    Importing a library may turn it into an ``ImportError``, and with that into a library that
    seems not to be there; a callback of the compiler drops it, and fails then for a reason of its
    own; and so does a ``__del__``. Whatever fails after an interrupt was interrupted.
    """
    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    hook, alarm = sys.unraisablehook, signal.getsignal(signal.SIGALRM)

    def raise_again(lost: "sys.UnraisableHookArgs") -> None:
        if issubclass(lost.exc_type, KeyboardInterrupt):
            _interrupt_later()
        else:
            hook(lost)

    sys.unraisablehook = raise_again
    signal.signal(signal.SIGALRM, _interrupt)
    signal.signal(signal.SIGINT, _interrupt)
    _raised.clear()
    try:
        yield
    except Exception as error:
        if _raised.is_set():
            raise KeyboardInterrupt from error
        raise
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGALRM, alarm)
        sys.unraisablehook = hook


@contextmanager
def sigterm_interrupts() -> Iterator[None]:
    """Let SIGTERM raise KeyboardInterrupt, as SIGINT does: then servers are stopped, too."""
    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _interrupt(_number: int, frame: FrameType | None) -> None:
    while frame is not None:
        if _SWALLOW.search(frame.f_code.co_filename):
            return _interrupt_later()
        frame = frame.f_back
    _raised.set()
    raise KeyboardInterrupt


def _interrupt_later() -> None:
    signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
