"""How the service manager hears of a server: that it starts, that it serves, that it still does."""

import logging
import threading

from triquad_server.health import STUCK_S, Health
from triquad_server.phases import Phases
from triquad_server.process.service_manager import ServiceManager
from triquad_server.self_question import SelfQuestion

_log = logging.getLogger(__name__)

_STATUS_PERIOD_S = 10.0  # where the manager does not say how often it wants to hear anything
_SOONER = 10  # times sooner, a server is checked again that was not well


class Supervision(Phases):
    """Tells the service manager of a server that is a process of its own.

    It hears that the server is alive as long as maps are learnt and questions are answered: once
    they are not, nothing but a restart helps. From the moment that the server is asked to stop it
    is believed; how long a last checkpoint may take is the manager's to say.
    """

    def __init__(self, manager: ServiceManager) -> None:
        self._manager = manager
        self._stopping = threading.Event()
        self._closing = threading.Event()
        self._was_well = True
        self._thread: threading.Thread | None = None

    def starting(self, stage: str) -> None:
        """Tell which stage of the start begins."""
        self._manager.starting(stage)

    def serving(self, health: Health, question: SelfQuestion) -> None:
        """Tell that the server serves, and from now on how it does."""
        self._manager.tell("READY=1", status=health.summary())
        if self._manager.listens:
            self._thread = threading.Thread(
                target=self._run, args=(health, question), name="supervision"
            )
            self._thread.start()

    def stopping(self) -> None:
        """Tell that the server stops."""
        self._stopping.set()
        self._manager.tell(
            "STOPPING=1", status="what waits is answered, and the last checkpoint is written"
        )

    def close(self) -> None:
        """Say nothing more."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self, health: Health, question: SelfQuestion) -> None:
        watchdog_s = self._manager.watchdog_s
        period_s = _STATUS_PERIOD_S if watchdog_s is None else watchdog_s / 2
        while not self._closing.wait(period_s if self._was_well else period_s / _SOONER):
            problem = None
            if watchdog_s is not None and not self._stopping.is_set():
                problem = _problem(health, question, watchdog_s)
            self._tell(None if self._stopping.is_set() else problem)
            if not self._stopping.is_set():
                self._manager.tell(status=health.summary())

    def _tell(self, problem: str | None) -> None:
        """Tell that the server is alive, or the log why that is not told."""
        if problem is None and self._manager.watchdog_s is not None:
            self._manager.tell("WATCHDOG=1")
        elif problem is not None and self._was_well:
            _log.error("the service manager is not told any more that all is well: %s", problem)
        self._was_well = problem is None


def _problem(health: Health, question: SelfQuestion, watchdog_s: float) -> str | None:
    """Why the server does not map, or does not answer, any more; ``None`` where it does both."""
    mapping = health.mapping_problem(min(STUCK_S, watchdog_s))
    return mapping or question.problem(timeout_s=watchdog_s / 2)
