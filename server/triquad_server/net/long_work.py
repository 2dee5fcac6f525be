"""How much of the time long questions take, while others ask as well."""

import threading
import time

_REST = 3.0
"""How many times as long as a slice took: mapping and the network need the cores, too."""

_LONGEST_REST_S = 0.25


class LongWork:
    """The share of all long questions together, however many there are; safe for any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._rests_until_s = 0.0  # monotonic

    def rest_s(self, took_s: float) -> float:
        """How long a question rests of which a slice ``took_s``."""
        with self._lock:
            now = time.monotonic()
            self._rests_until_s = max(self._rests_until_s, now) + _REST * took_s
            # A slice that took very long, as it may before others asked, is not made up for.
            self._rests_until_s = min(self._rests_until_s, now + _LONGEST_REST_S)
            return self._rests_until_s - now
