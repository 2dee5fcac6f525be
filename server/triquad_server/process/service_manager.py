"""Notifies systemd, or a manager with the same protocol, by datagrams of sd_notify(3)."""

import logging
import os
import socket

from triquad_format.printable import printable

_log = logging.getLogger("triquad_server")

_STAGE_S = 300  # the longest that one stage of the start may take


class ServiceManager:
    """Notifies the service manager of the server's state; sends nothing where there is none."""

    def __init__(self) -> None:
        name = os.environ.get("NOTIFY_SOCKET", "")  # of an abstract socket if it begins with @
        self._address = "\0" + name[1:] if name.startswith("@") else name
        self.listens = bool(name)
        period_us = os.environ.get("WATCHDOG_USEC", "0")
        ours = os.environ.get("WATCHDOG_PID") in (None, str(os.getpid())) and period_us.isdecimal()
        self.watchdog_s = int(period_us) / 1e6 or None if self.listens and ours else None

    def starting(self, stage: str) -> None:
        """Report that the server begins the next stage of its start, which may take a while."""
        self.notify(f"EXTEND_TIMEOUT_USEC={_STAGE_S * 1_000_000}", status=stage)

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
