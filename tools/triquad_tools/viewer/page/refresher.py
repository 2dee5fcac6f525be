"""Work that is done again and again in the background."""

import logging
import threading
from collections.abc import Callable

from triquad_format.errors import TriquadError

_log = logging.getLogger(__name__)

_LEAST_S = 0.05  # between one time and the next, however often it is woken


class Refresher:
    """Calls ``refresh`` on a thread of its own: whenever it is woken, and after each period.

    Where that raises, ``failed`` is told in words, and it is tried again after the period; once it
    does not any more, ``failed`` is told nothing (an empty text).
    """

    def __init__(
        self,
        name: str,
        refresh: Callable[[], None],
        *,
        period_s: float,
        failed: Callable[[str], None],
    ) -> None:
        self._refresh = refresh
        self._period_s = period_s
        self._failed = failed
        self._woken = threading.Event()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """Let it be done soon."""
        self._woken.set()

    def close(self) -> None:
        """Do it no more; one that is under way ends first."""
        self._stopped.set()
        self._woken.set()
        self._thread.join()

    def _run(self) -> None:
        failing = False
        while not self._stopped.is_set():
            self._woken.clear()
            try:
                self._refresh()
                if failing:
                    self._failed("")
                failing = False
            except TriquadError as error:
                failing = True
                self._failed(str(error))
            except Exception as error:
                _log.exception("%s failed", self._thread.name)
                failing = True
                self._failed(f"{type(error).__name__}: {error}")
            self._stopped.wait(_LEAST_S)
            self._woken.wait(self._period_s)
