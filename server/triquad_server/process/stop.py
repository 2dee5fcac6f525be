"""The reasons for which a server stops; quick to import, so that signals are handled early."""

import logging
import queue
import threading
from collections.abc import Callable
from contextlib import suppress
from enum import Enum

from triquad_server.errors import NO_MEMORY

_log = logging.getLogger("triquad_server")


class Stop(Enum):
    """The reason for which a server stops."""

    ASKED = "asked to"
    INTERNAL_ERROR = "by an internal error"
    NO_MEMORY = f"as {NO_MEMORY}"


Stops = queue.SimpleQueue[Stop]
"""A queue that signal handlers and internal errors use to ask the server to stop."""

_WAKE_S = 0.5


def wait_for_stop(stops: Stops, meanwhile: Callable[[], None] = lambda: None) -> Stop:
    """Wait until something asks the server to stop, or until the program's main thread has ended.

    Twice a second ``meanwhile`` is called.

    The system may deliver a signal to any thread, a library's too, and its Python handler runs once
    the main thread does: so that thread must not block for good.
    """
    why: Stop | None = None
    while why is None and threading.main_thread().is_alive():
        meanwhile()
        with suppress(queue.Empty):
            why = stops.get(timeout=_WAKE_S)
    why = why or Stop.ASKED
    _log.info("stopping, %s", why.value)
    return why
