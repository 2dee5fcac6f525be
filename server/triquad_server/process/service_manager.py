"""What the service manager is told that started this process: systemd, or what speaks as it does.

Source: sd_notify(3), whose protocol is one datagram of lines ``KEY=value`` to a socket that the
environment names.
"""

import logging
import os
import socket
from collections.abc import Mapping

from triquad_server.process.log_lines import one_line

_log = logging.getLogger("triquad_server")

_SEND_S = 5.0  # a manager that does not listen must not hold up the server
_STAGE_S = 300  # the longest that one stage of the start may take


class ServiceManager:
    """Tells the service manager how the server does; nobody where there is none."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = _address(environment.get("NOTIFY_SOCKET", ""))
        self.watchdog_s = _watchdog_s(environment) if self._address else None
        """How often it wants to hear :meth:`alive` at least; ``None``: not at all."""

    @property
    def listens(self) -> bool:
        """Whether there is one."""
        return self._address is not None

    def starting(self, stage: str) -> None:
        """The server comes to the next stage of its start, which may take a while."""
        self._tell(f"STATUS={one_line(stage)}", f"EXTEND_TIMEOUT_USEC={_STAGE_S * 1_000_000}")

    def ready(self, status: str) -> None:
        """The server serves."""
        self._tell("READY=1", f"STATUS={one_line(status)}")

    def status(self, status: str) -> None:
        """What the server does, in one line."""
        self._tell(f"STATUS={one_line(status)}")

    def alive(self) -> None:
        """The server does what it is there for."""
        if self.watchdog_s is not None:
            self._tell("WATCHDOG=1")

    def stopping(self, status: str) -> None:
        """The server was asked to stop."""
        self._tell("STOPPING=1", f"STATUS={one_line(status)}")

    def _tell(self, *lines: str) -> None:
        if self._address is None:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
                sender.settimeout(_SEND_S)
                sender.sendto("\n".join(lines).encode(), self._address)
        except OSError as error:
            _log.warning("the service manager could not be told %s: %s", lines[0], error)


def _address(name: str) -> str | None:
    """The address of a socket in the file system, or of an abstract one, which begins with @."""
    if name.startswith("@"):
        return "\0" + name[1:]
    if name and not name.startswith("/"):
        _log.warning("NOTIFY_SOCKET = %r is neither a path nor an abstract socket: ignored", name)
        return None
    return name or None


def _watchdog_s(environment: Mapping[str, str]) -> float | None:
    """The time within which it wants to hear that this very process is alive."""
    period, process = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
    if not period or process not in ("", str(os.getpid())):
        return None
    if not (period.isascii() and period.isdigit()) or int(period) == 0:
        _log.warning("WATCHDOG_USEC = %r is no time in microseconds: ignored", period)
        return None
    return int(period) / 1e6
