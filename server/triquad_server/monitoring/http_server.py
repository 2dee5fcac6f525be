"""The port on which programs that watch the server ask over HTTP how it is doing."""

import json
import logging
import socket
import socketserver
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler
from typing import Any

from triquad_map.compiled.team import lower_priority

from triquad_server.errors import ListenError, ServerError
from triquad_server.process.threads import NICENESS
from triquad_server.server_status import Health
from triquad_server.settings import MetricsSettings

try:
    from triquad_server.monitoring.prometheus import Figures, exposition
except ImportError as error:
    raise ServerError(
        "prometheus-client is missing: install triquad[server], or leave metrics.port at 0"
    ) from error

_log = logging.getLogger(__name__)

_AT_ONCE = 8  # connections; further ones are closed
_TIMEOUT_S = 10.0  # for a request and its answer; slower connections are closed
_TEXT = "text/plain; version=0.0.4; charset=utf-8"  # as Prometheus calls its format


Shown = Callable[[], Sequence[Health]]
"""Returns what tells how the maps of a server are doing."""


class MonitoringServer(socketserver.ThreadingTCPServer):
    """Answers ``/metrics`` for Prometheus and ``/healthz``, on a bounded number of threads.

    It listens from the start, and says that the server is starting until it has metrics to show.
    """

    allow_reuse_address = True
    daemon_threads = True

    def __init__(self, settings: MetricsSettings) -> None:
        """Begin to listen.

        Raises:
            ListenError: the port is taken, or cannot be listened on.
        """
        self.shown: Shown | str = "the server is starting: it restores its map and compiles code"
        self._since_s: dict[socket.socket, float] = {}  # of open connections, monotonic
        where = (settings.address, settings.port)
        named = f"[{where[0]}]:{where[1]}" if ":" in where[0] else f"{where[0]}:{where[1]}"
        try:
            self.address_family = socket.getaddrinfo(*where, type=socket.SOCK_STREAM)[0][0]
            super().__init__(where, _Handler)
        except (OSError, ValueError) as error:
            raise ListenError(
                f"cannot listen on {named} for metrics: {error}; choose another port with "
                "--metrics-port or metrics.port, or another metrics.address"
            ) from error
        self._thread = threading.Thread(target=self.serve_forever, name="monitoring")
        self._thread.start()
        _log.info("metrics on http://%s/metrics, health on /healthz", named)

    @contextmanager
    def showing(self, shown: Shown) -> Iterator[None]:
        """Show the figures of a server that has started; after the context, that it stops."""
        self.shown = shown
        try:
            yield
        finally:
            self.shown = "the server is stopping"

    def close(self) -> None:
        """Stop listening."""
        self.shutdown()
        self._thread.join()
        self.server_close()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer a connection on a thread of its own, unless too many are open."""
        if len(self._since_s) >= _AT_ONCE:
            self.shutdown_request(request)
            return
        self._since_s[request] = time.monotonic()
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        self._since_s.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """End connections that stall or trickle, which their threads then close; twice a second."""
        for request, since_s in list(self._since_s.items()):
            if time.monotonic() - since_s > _TIMEOUT_S:
                with suppress(OSError):
                    request.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Keep clients that leave before their answer out of the log."""
        _log.debug("%s of %s failed", request, client_address, exc_info=True)


class _Handler(BaseHTTPRequestHandler):
    server: MonitoringServer

    def setup(self) -> None:
        """Leave the cores to queries: a scrape can wait."""
        lower_priority(NICENESS)
        super().setup()

    def do_GET(self) -> None:  # noqa: N802 - the name that the library looks for
        """Answer with a page, or for ``HEAD`` with what stands before it."""
        try:
            code, content_type, text = _page(self.path.partition("?")[0], self.server.shown)
        except Exception:
            _log.exception("an internal error, while %.200r was asked for", self.path)
            code, content_type, text = 500, _TEXT, "internal error: see the log\n"
        body = text.encode()
        self.send_response(code)
        self.send_header("Content-Type", content_type)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    do_HEAD = do_GET  # noqa: N815 - as probes of load balancers ask

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - as in the library
        """Keep requests out of the log, except for debugging."""
        _log.debug("%s: " + format, self.address_string(), *args)


def _page(path: str, shown: Shown | str) -> tuple[int, str, str]:
    """Return status, content type and text of what is at a path."""
    if path == "/healthz":
        report = {"problem": shown} if isinstance(shown, str) else _health(shown())
        code = 200 if report["problem"] is None else 503
        return code, "application/json", json.dumps(report) + "\n"
    if path != "/metrics":
        return 404, _TEXT, f"nothing is at {path!r:.200}: use /metrics or /healthz\n"
    if isinstance(shown, str):
        return 503, _TEXT, shown + "\n"
    return 200, _TEXT, exposition([Figures(one.status(), one.metrics()) for one in shown()])


def _health(maps: Sequence[Health]) -> dict[str, object]:
    """Return what a supervisor reads; ``problem`` is ``None`` where all is well."""
    found = {one.map_name: _of_map(one) for one in maps}
    problem = next(filter(None, (one["problem"] for one in found.values())), None)
    return {"problem": problem, "maps": found}


def _of_map(health: Health) -> dict[str, object]:
    status = health.status()
    names = ("server", "epoch", "settled", "scans_taken", "uptime_s")
    return {"problem": health.problem(), **{name: getattr(status, name) for name in names}}
