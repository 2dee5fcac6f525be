"""Threads that receive requests, and work at them."""

import logging
import threading
from collections.abc import Callable, Iterable
from typing import Generic, TypeVar

from triquad_map.compiled.priority import lower_priority

_log = logging.getLogger(__name__)

_MOST_WAITING = 8
"""Threads that stay for what comes next: to start one takes as long as a short request."""

ArrivalT = TypeVar("ArrivalT")


class Receivers(Generic[ArrivalT]):
    """Threads of which one always waits for what arrives: whoever takes it handles it.

    So no other thread has to be woken before the work begins, and what arrives meanwhile is
    received at once, however long that work takes.
    """

    def __init__(
        self,
        arrivals: Iterable[ArrivalT],
        handle: Callable[[ArrivalT], None],
        *,
        name: str,
        niceness: int = 0,
    ) -> None:
        """Begin to receive. Several threads iterate over ``arrivals`` at the same time.

        ``handle`` raises nothing; for ``niceness`` see :func:`lower_priority`.
        """
        self._arrivals = arrivals
        self._handle = handle
        self._name = name
        self._niceness = niceness
        self._lock = threading.Lock()
        self._threads: set[threading.Thread] = set()
        self._waiting = 0  # of the threads
        self._start()

    def join(self) -> None:
        """Wait until all has been handled; nothing arrives any more."""
        while (thread := self._any_thread()) is not None:
            thread.join()

    def _any_thread(self) -> threading.Thread | None:
        with self._lock:
            self._threads = {thread for thread in self._threads if thread.is_alive()}
            return next(iter(self._threads), None)

    def _start(self) -> None:
        """Have another thread wait."""
        thread = threading.Thread(target=self._run, name=self._name)
        with self._lock:
            self._waiting += 1
            try:
                thread.start()
            except RuntimeError as error:
                self._waiting -= 1
                _log.warning("%s: requests wait for one that is worked at: %s", self._name, error)
            else:
                self._threads.add(thread)

    def _run(self) -> None:
        lower_priority(self._niceness)
        for arrival in self._arrivals:
            with self._lock:
                self._waiting -= 1
                is_last = self._waiting == 0
            if is_last:
                self._start()
            self._handle(arrival)
            with self._lock:
                if self._waiting >= _MOST_WAITING:
                    self._threads.discard(threading.current_thread())
                    return
                self._waiting += 1
