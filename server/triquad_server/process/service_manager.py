"""Notifies systemd, or a manager with the same protocol, by datagrams of sd_notify(3)."""

import logging
import os
import socket
import time
from collections.abc import Callable

from triquad_format.printable import printable

_log = logging.getLogger("triquad_server")

_STAGE_S = 300  # the longest that one stage of the start may take
_STATUS_PERIOD_S = 10.0  # where the manager does not set how often to report


class ServiceManager:
    """Notifies the service manager of the server's state; sends nothing where there is none.

    The server is alive as long as maps are learnt and queries are answered: once they are not,
    nothing but a restart helps.
    """

    def __init__(self) -> None:
        name = os.environ.get("NOTIFY_SOCKET", "")  # of an abstract socket if it begins with @
        self._address = "\0" + name[1:] if name.startswith("@") else name
        self.listens = bool(name)
        period_us = os.environ.get("WATCHDOG_USEC", "0")
        ours = os.environ.get("WATCHDOG_PID") in (None, str(os.getpid())) and period_us.isdecimal()
        self.watchdog_s = int(period_us) / 1e6 or None if self.listens and ours else None
        self._due_s = 0.0  # when to report next, monotonic
        self._was_well = True

    def starting(self, stage: str) -> None:
        """Report that the server begins the next stage of its start, which may take a while."""
        self.notify(f"EXTEND_TIMEOUT_USEC={_STAGE_S * 1_000_000}", status=stage)

    def serving(self, summary: Callable[[], str], problem: Callable[[float], str | None]) -> None:
        """Report what the server does, and that it is alive; call this twice a second.

        A report follows in its time, or at once where the server was not well before. ``problem``
        returns why the server does not map, or does not answer, for longer than some seconds.
        """
        now = time.monotonic()
        if not self.listens or (self._was_well and now < self._due_s):
            return
        watchdog_s = self.watchdog_s
        lines: tuple[str, ...] = ()
        self._due_s = now + (_STATUS_PERIOD_S if watchdog_s is None else watchdog_s / 2)
        if watchdog_s is not None:
            found = problem(watchdog_s)
            if found is None:
                lines = ("WATCHDOG=1",)
            elif self._was_well:
                _log.error("the service manager gets no more signs that all is well: %s", found)
            self._was_well = found is None
        self.notify(*lines, status=summary())

    def stopping(self) -> None:
        """Report that the server stops: the manager decides how long a last checkpoint may take."""
        self.notify(
            "STOPPING=1", status="what waits is answered, and the last checkpoint is written"
        )

    def notify(self, *lines: str, status: str = "") -> None:
        """Send lines such as ``READY=1``, and a status in words."""
        if not self.listens:
            return
        lines += (f"STATUS={printable(status)}",) if status else ()
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
                sender.settimeout(5.0)  # a manager that does not listen must not stop the server
                sender.sendto("\n".join(lines).encode(), self._address)
        except OSError as error:
            _log.warning("the service manager could not be notified of %s: %s", lines[0], error)
