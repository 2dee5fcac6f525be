"""Reports to the service manager that a server starts, that it serves, and that it still works."""

import logging
import threading

import numpy as np
import zenoh
from triquad_format.errors import WireError
from triquad_format.wire import codec, keys
from triquad_format.wire.messages import ErrorReply, RequestOrigin, SdfRequest

from triquad_server.process.service_manager import ServiceManager
from triquad_server.server_status import STUCK_S
from triquad_server.service import Service

_log = logging.getLogger(__name__)

_STATUS_PERIOD_S = 10.0  # where the manager does not set how often to report
_SOONER = 10  # factor by which a server that was not well is checked again sooner


class Supervision:
    """Notifies the service manager of a server that is a process of its own.

    It reports that the server is alive as long as maps are learnt and queries are answered: once
    they are not, nothing but a restart helps. From the moment that the server is asked to stop it
    counts as alive; the manager decides how long a last checkpoint may take.
    """

    def __init__(self, manager: ServiceManager) -> None:
        self._manager = manager
        self._stopping = threading.Event()
        self._closing = threading.Event()
        self._was_well = True
        self._thread: threading.Thread | None = None

    def starting(self, stage: str) -> None:
        """Report which stage of the start begins."""
        self._manager.starting(stage)

    def serving(self, service: Service) -> None:
        """Report that the server serves, and from now on its state."""
        self._manager.notify("READY=1", status=service.health.summary())
        if self._manager.listens:
            self._thread = threading.Thread(target=self._run, args=(service,), name="supervision")
            self._thread.start()

    def stopping(self) -> None:
        """Report that the server stops."""
        self._stopping.set()
        self._manager.notify(
            "STOPPING=1", status="what waits is answered, and the last checkpoint is written"
        )

    def close(self) -> None:
        """Report nothing more."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self, service: Service) -> None:
        watchdog_s = self._manager.watchdog_s
        period_s = _STATUS_PERIOD_S if watchdog_s is None else watchdog_s / 2
        while not self._closing.wait(period_s if self._was_well else period_s / _SOONER):
            problem = None
            if watchdog_s is not None and not self._stopping.is_set():
                problem = _problem(service, watchdog_s)
            self._report(None if self._stopping.is_set() else problem)
            if not self._stopping.is_set():
                self._manager.notify(status=service.health.summary())

    def _report(self, problem: str | None) -> None:
        """Report that the server is alive, or log why not."""
        if problem is None and self._manager.watchdog_s is not None:
            self._manager.notify("WATCHDOG=1")
        elif problem is not None and self._was_well:
            _log.error("the service manager gets no more signs that all is well: %s", problem)
        self._was_well = problem is None


def _problem(service: Service, watchdog_s: float) -> str | None:
    """Return why the server does not map, or does not answer; ``None`` if it does both."""
    mapping = service.health.mapping_problem(min(STUCK_S, watchdog_s))
    return mapping or _question_problem(service, timeout_s=watchdog_s / 2)


def _question_problem(service: Service, timeout_s: float) -> str | None:
    """Query the field at one point, as clients do; return an error if no answer came in time.

    A refusal, where too many requests wait, is an answer. The server has turns of its own, as any
    client.
    """
    request = SdfRequest(np.zeros(3), np.zeros((1, 3), np.float32), gradient=False, epoch=0)
    replies = service.session.get(
        keys.operation_key(service.health.map_name, keys.SDF),
        payload=codec.encode(request),
        attachment=codec.encode(RequestOrigin(service.own_name, timeout_s)),
        timeout=timeout_s,
        allowed_destination=zenoh.Locality.SESSION_LOCAL,
    )
    if any(reply.err is None or _is_ours(reply.err) for reply in replies):
        return None
    return f"a question that the server asked itself got no answer within {timeout_s:g} s"


def _is_ours(error: zenoh.ReplyError) -> bool:
    """Return whether an error comes from the server, not from Zenoh, whose wait has ended."""
    try:
        codec.decode(ErrorReply, error.payload.to_bytes())
    except WireError:
        return False
    return True
