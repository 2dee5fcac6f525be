"""Refusing requests: in threads of their own, and each one while a server starts."""

import threading
from concurrent.futures import ThreadPoolExecutor

import zenoh
from triquad_format.wire import codec, keys
from triquad_format.wire.messages import ErrorReply

from triquad_server.process.threads import submit
from triquad_server.serving.request import Request

_REFUSING_THREADS = 2

_REFUSED_BYTES = 4_000_000
"""The memory of requests that wait for these threads: beyond, large ones are refused by the
network's thread, so that their sender waits for it and they take no memory."""

_LARGE_BYTES = 65_536


class RefusalSender:
    """Sends refusals in threads of its own: a client may delay the reply for seconds."""

    def __init__(self) -> None:
        self._threads = ThreadPoolExecutor(_REFUSING_THREADS, "refusals")
        self._lock = threading.Lock()
        self._waiting_bytes = 0

    def send(self, request: Request, code: str, text: str) -> None:
        """Refuse a request; ``code`` is one of ``ERROR_CODES``."""
        size = request.size
        with self._lock:
            is_room = size <= _LARGE_BYTES or self._waiting_bytes + size <= _REFUSED_BYTES
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


class StartingNotice:
    """Tells clients, until it is closed, that the server of a map is there but not ready."""

    def __init__(self, session: zenoh.Session, map_name: str) -> None:
        """Begin to refuse questions."""
        self.stage = "it has just begun"
        # Zenoh's own thread answers: the others may be compiling.
        self._queryable = session.declare_queryable(
            keys.all_queries_key(map_name), zenoh.handlers.Callback(self._refuse, indirect=False)
        )

    def close(self) -> None:
        """Refuse no more."""
        self._queryable.undeclare()

    def _refuse(self, query: zenoh.Query) -> None:
        reply = codec.encode(ErrorReply("starting", self.stage))
        with query:
            query.reply_err(reply, encoding=keys.encoding(ErrorReply))
