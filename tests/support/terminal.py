"""Commands on a real pseudo-terminal."""

import fcntl
import os
import pty
import re
import select
import signal
import struct
import sys
import termios
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

from support.servers import WAIT_S

_CONTROLS = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
_HOME = "\x1b[H"


@dataclass
class Terminal:
    """A terminal, and the process that it belongs to."""

    process: int
    device: int
    shown: str = ""
    has_ended: bool = False
    _waiting_from: int = 0  # characters that were shown before

    @property
    def page(self) -> str:
        """The last page that was drawn whole, as text."""
        pages = self.shown[self._waiting_from :].split(_HOME)
        return _CONTROLS.sub("", pages[-2] if len(pages) > 1 else "")

    def resize(self, columns: int, lines: int) -> None:
        """Have it so many columns and lines."""
        size = struct.pack("HHHH", lines, columns, 0, 0)
        fcntl.ioctl(self.device, termios.TIOCSWINSZ, size)

    def wait_for(self, pattern: str) -> str:
        """Return the page once it holds this; what was shown before does not count."""
        end_s = time.monotonic() + WAIT_S
        self._waiting_from = len(self.shown)
        while not re.search(pattern, self.page):
            assert time.monotonic() < end_s, f"no {pattern!r} in:\n{self.page}"
            assert self._read(end_s), f"it ended without {pattern!r}:\n{self.shown}"
        return self.page

    def wait(self) -> int:
        """The exit code, once it ends."""
        end_s = time.monotonic() + WAIT_S
        while self._read(end_s):
            assert time.monotonic() < end_s, f"it has not ended:\n{self.page}"
        self.has_ended = True
        return os.waitstatus_to_exitcode(os.waitpid(self.process, 0)[1])

    def _read(self, end_s: float) -> bool:
        """Take what was written; false once nobody can write any more."""
        if not select.select([self.device], [], [], max(0.0, end_s - time.monotonic()))[0]:
            return True
        try:
            written = os.read(self.device, 1 << 16)
        except OSError:  # as Linux says that the other side is closed
            return False
        self.shown += written.decode()
        return bool(written)


@contextmanager
def terminal(
    code: str, *arguments: str, size: tuple[int, int] = (80, 24), environment: Mapping[str, str]
) -> Iterator[Terminal]:
    """A terminal in which Python runs ``code``; ``size`` is in columns and lines."""
    process, device = pty.fork()
    if process == 0:
        line = [sys.executable, "-c", code, *arguments]
        os.execve(sys.executable, line, {**os.environ, "TERM": "xterm-256color", **environment})
    opened = Terminal(process, device)
    try:
        opened.resize(*size)
        yield opened
    finally:
        os.close(device)
        if not opened.has_ended:  # under nohup it would outlive its terminal
            os.kill(process, signal.SIGKILL)
            os.waitpid(process, 0)
