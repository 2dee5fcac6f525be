"""How many bytes something may take at a time."""

import threading


class ByteBudget:
    """Counts bytes that are taken and given back; safe for any thread."""

    def __init__(self, most: int, *, small: int) -> None:
        """At most ``most`` bytes are taken at a time; what has ``small`` of them always is."""
        self._most = most
        self._small = small
        self._lock = threading.Lock()
        self._used = 0

    def take(self, nbytes: int) -> bool:
        """Count bytes from now on; False, and they do not count, where there is no room.

        What is more than all may be together is taken where nothing else is.
        """
        with self._lock:
            if nbytes > self._small and self._used > 0 and self._used + nbytes > self._most:
                return False
            self._used += nbytes
            return True

    def give_back(self, nbytes: int) -> None:
        """Count bytes no more."""
        with self._lock:
            self._used -= nbytes
