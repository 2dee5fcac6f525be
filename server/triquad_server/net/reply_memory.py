"""How much memory replies take that are on their way, to clients that may not read them."""

import threading

MOST_BYTES = 64_000_000
"""Of all replies on their way; a large one beyond is not sent."""

SMALL_BYTES = 262_144
"""A reply of no more, such as a planner's, always is."""


class ReplyMemory:
    """Counts the bytes of the replies of all operations; safe for any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._used = 0

    def take(self, nbytes: int) -> bool:
        """Count a reply from now on; False, and it does not count, where there is no room."""
        with self._lock:
            if nbytes > SMALL_BYTES and self._used > 0 and self._used + nbytes > MOST_BYTES:
                return False
            self._used += nbytes
            return True

    def give_back(self, nbytes: int) -> None:
        """Count a reply no more."""
        with self._lock:
            self._used -= nbytes
