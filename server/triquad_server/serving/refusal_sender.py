"""Sends the refusals of requests with which no worker begins."""

import threading
from concurrent.futures import ThreadPoolExecutor

from triquad_server.process.threads import submit
from triquad_server.serving.request import Request

_THREADS = 2

_MOST_BYTES = 4_000_000
"""The memory of requests that wait for these threads: beyond, large ones are refused by the
network's thread, so that their sender waits for it and they take no memory."""

_LARGE_BYTES = 65_536


class RefusalSender:
    """Sends refusals in threads of its own: a client may delay the reply for seconds."""

    def __init__(self) -> None:
        self._threads = ThreadPoolExecutor(_THREADS, "refusals")
        self._lock = threading.Lock()
        self._waiting_bytes = 0

    def send(self, request: Request, code: str, text: str) -> None:
        """Refuse a request; ``code`` is one of ``ERROR_CODES``."""
        size = request.size
        with self._lock:
            is_room = size <= _LARGE_BYTES or self._waiting_bytes + size <= _MOST_BYTES
            if is_room:
                self._waiting_bytes += size
        if is_room:
            submit(self._threads, self._refuse, request, code, text)
        else:
            request.refuse(code, text)

    def close(self) -> None:
        """Refuse what is left, and end."""
        self._threads.shutdown()

    def _refuse(self, request: Request, code: str, text: str) -> None:
        size = request.size
        try:
            request.refuse(code, text)
        finally:
            with self._lock:
                self._waiting_bytes -= size
