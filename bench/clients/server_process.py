"""A ``triquad-server`` as a process of its own, as robots have it."""

import os
import queue
import resource
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

_WAIT_S = 300.0  # kernels are compiled on the first start


def free_port() -> int:
    """Return a port of the loopback that nothing uses."""
    with closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def free_endpoint() -> str:
    """Return an endpoint of the loopback that nothing uses."""
    return f"tcp/127.0.0.1:{free_port()}"


@dataclass
class ServerProcess:
    """A running server, whose log is read as it comes."""

    process: "subprocess.Popen[str]"
    endpoint: str
    lines: list[str] = field(default_factory=list)
    _unread: "queue.SimpleQueue[str | None]" = field(default_factory=queue.SimpleQueue)

    def __post_init__(self) -> None:
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    @property
    def log(self) -> str:
        """The log so far."""
        return "".join(self.lines)

    @property
    def resident_bytes(self) -> int:
        """The memory that the process has of its own in RAM."""
        pages = Path(f"/proc/{self.process.pid}/statm").read_text().split()[1]
        return int(pages) * resource.getpagesize()

    def wait_for(self, text: str) -> None:
        """Return once a line of the log holds ``text``."""
        while (line := self._unread.get(timeout=_WAIT_S)) is not None:
            if text in line:
                return
        raise AssertionError(f"the server ended without {text!r}:\n{self.log}")

    def wait(self) -> int:
        """Return the exit code, once it ends."""
        code = self.process.wait(_WAIT_S)
        self._reader.join()
        return code

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.lines.append(line)
            self._unread.put(line)
        self._unread.put(None)


@contextmanager
def server_process(
    arguments: Sequence[str | Path] = (),
    endpoint: str | None = None,
    ready: bool = True,
    environment: Mapping[str, str] | None = None,
    program: Sequence[str] = ("-m", "triquad_server.cli"),
    **pipes: Any,
) -> Iterator[ServerProcess]:
    """Yield a server once it is ``ready``; it is killed at the end if it still runs.

    ``environment`` has variables in addition to those of this process; another ``program`` of
    Python is one that serves, too. ``pipes`` are those to its standard input and output.
    """
    endpoint = endpoint or free_endpoint()
    command = [sys.executable, *program, "--listen", endpoint]
    command += map(str, arguments)
    variables = {**os.environ, **(environment or {})}
    variables.pop("PYTHONDONTWRITEBYTECODE", None)  # else a start takes twice as long
    pipes["stderr"] = subprocess.PIPE
    with subprocess.Popen(command, text=True, env=variables, **pipes) as process:
        server = ServerProcess(process, endpoint)
        try:
            if ready:
                server.wait_for("ready: ")
            yield server
        finally:
            if process.poll() is None:
                process.kill()
            server.wait()
