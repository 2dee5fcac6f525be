"""The port on which programs that watch the server ask over HTTP how it is doing."""

import io
import json
import logging
import socket
import socketserver
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from typing import TYPE_CHECKING, Any, NamedTuple

from triquad_map.compiled.priority import lower_priority

from triquad_server.errors import ListenError, ServerError
from triquad_server.monitoring.family import Figures
from triquad_server.monitoring.metrics import Metrics
from triquad_server.process.threads import NICENESS
from triquad_server.settings import MetricsSettings

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

_log = logging.getLogger(__name__)

_AT_ONCE = 8  # connections; further ones are closed
_TIMEOUT_S = 10.0  # until a connection's request is there, and until its answer is taken
_STARTING = "the server is starting: it restores its map and prepares compiled code"
_STOPPING = "the server is stopping"


class _Page(NamedTuple):
    """An answer."""

    code: HTTPStatus
    body: bytes
    content_type: str


class MonitoringServer:
    """Answers ``/metrics`` for Prometheus and ``/healthz``, on threads of its own.

    It listens from the start, and says that the server is starting until it has metrics to show.
    """

    def __init__(self, settings: MetricsSettings) -> None:
        """Begin to listen.

        Raises:
            ListenError: the port is taken, or cannot be listened on.
            ServerError: prometheus-client is not installed.
        """
        _require_prometheus()
        self._shown: Metrics | str = _STARTING  # or why there are none
        self._listener = _listener(settings, self)
        self._thread = threading.Thread(target=self._listener.serve_forever, name="monitoring")
        self._thread.start()
        _log.info("metrics on http://%s/metrics, health on /healthz", _where(settings))

    @contextmanager
    def showing(self, metrics: Metrics) -> Iterator[None]:
        """The server has started; once the context ends, it is stopping."""
        self._shown = metrics
        try:
            yield
        finally:
            self._shown = _STOPPING

    def close(self) -> None:
        """Stop listening."""
        self._listener.shutdown()
        self._thread.join()
        self._listener.server_close()

    def page(self, path: str, accept: str) -> _Page:
        """What is at ``path``; ``accept`` is the request's header of that name."""
        if path == "/healthz":
            return self._health()
        if path == "/metrics":
            return self._exposition(accept)
        text = f"nothing is at {path!r:.200}: use /metrics or /healthz\n"
        return _text(HTTPStatus.NOT_FOUND, text)

    def _health(self) -> _Page:
        shown = self._shown
        report = {"problem": shown} if isinstance(shown, str) else shown.health.report()
        healthy = report["problem"] is None
        code = HTTPStatus.OK if healthy else HTTPStatus.SERVICE_UNAVAILABLE
        return _Page(code, json.dumps(report).encode() + b"\n", "application/json")

    def _exposition(self, accept: str) -> _Page:
        # Only here, since this is the only place that needs prometheus-client.
        from triquad_server.monitoring.exposition import exposition

        shown = self._shown
        if isinstance(shown, str):
            return _text(HTTPStatus.SERVICE_UNAVAILABLE, shown + "\n")
        figures = Figures(shown.health.status(), shown.now())
        return _Page(HTTPStatus.OK, *exposition(figures, accept))


def _require_prometheus() -> None:
    try:
        import prometheus_client  # noqa: F401 - asks whether it is there
    except ImportError as error:
        raise ServerError(
            "prometheus-client is missing: install triquad[server], or leave metrics.port at 0"
        ) from error


def _text(code: HTTPStatus, text: str) -> _Page:
    return _Page(code, text.encode(), "text/plain; charset=utf-8")


def _where(settings: MetricsSettings) -> str:
    """Address and port as they stand in a URL."""
    address = f"[{settings.address}]" if ":" in settings.address else settings.address
    return f"{address}:{settings.port}"


class _TimelyInput(socket.SocketIO):
    """What comes on a connection until a time: byte by byte, nobody holds it for longer."""

    def __init__(self, connection: socket.socket, timeout_s: float) -> None:
        super().__init__(connection, "r")
        self._connection = connection
        self._ends_s = time.monotonic() + timeout_s

    def readinto(self, buffer: "WriteableBuffer") -> int | None:
        """What is there next.

        Raises:
            TimeoutError: the time is over.
        """
        left_s = self._ends_s - time.monotonic()
        if left_s <= 0.0:
            raise TimeoutError("the request took too long")
        self._connection.settimeout(left_s)
        return super().readinto(buffer)


class _Handler(BaseHTTPRequestHandler):
    """Answers one request."""

    timeout = _TIMEOUT_S
    server: "_Listener"

    def setup(self) -> None:
        """Leave the cores to queries: nobody waits for a scrape."""
        lower_priority(NICENESS)
        super().setup()
        self.rfile.close()
        self.rfile = io.BufferedReader(_TimelyInput(self.connection, _TIMEOUT_S))

    def do_GET(self) -> None:  # noqa: N802 - the name that the library looks for
        """Send the page."""
        self.wfile.write(self._send_head())

    def do_HEAD(self) -> None:  # noqa: N802 - the name that the library looks for
        """Send what stands before the page, as probes of load balancers ask for."""
        self._send_head()

    def _send_head(self) -> bytes:
        """Send what stands before a page; returns the page."""
        path = self.path.partition("?")[0]
        try:
            page = self.server.monitoring.page(path, self.headers.get("Accept", ""))
        except Exception:
            _log.exception("an internal error, while %.200r was asked for", path)
            page = _text(HTTPStatus.INTERNAL_SERVER_ERROR, "internal error: see the log\n")
        self.connection.settimeout(_TIMEOUT_S)
        self.send_response(page.code)
        self.send_header("Content-Type", page.content_type)
        self.send_header("Content-Length", str(len(page.body)))
        self.end_headers()
        return page.body

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - as in the library
        """Keep requests out of the log, but for debugging."""
        _log.debug("%s: " + format, self.address_string(), *args)


class _Listener(socketserver.ThreadingTCPServer):
    """Listens, and answers each connection on a thread of its own."""

    allow_reuse_address = True
    daemon_threads = True

    def __init__(
        self, family: socket.AddressFamily, where: tuple[str, int], monitoring: MonitoringServer
    ) -> None:
        self.address_family = family
        self.monitoring = monitoring
        self._room = threading.BoundedSemaphore(_AT_ONCE)
        super().__init__(where, _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer a connection, unless too many are open."""
        if not self._room.acquire(blocking=False):
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except BaseException:  # no thread could be started
            self._room.release()
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer a connection, on its own thread."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._room.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that goes amid its answer is no matter for the log."""
        _log.debug("%s of %s broke", request, client_address, exc_info=True)


def _listener(settings: MetricsSettings, monitoring: MonitoringServer) -> _Listener:
    try:
        family, *_ = socket.getaddrinfo(
            settings.address, settings.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        return _Listener(family, (settings.address, settings.port), monitoring)
    except (OSError, ValueError) as error:
        raise ListenError(
            f"cannot listen on {_where(settings)} for metrics: {error}; choose another port with "
            "--metrics-port or metrics.port, or another metrics.address"
        ) from error
