"""The demonstration's server: a ``triquad-server`` process of its own."""

import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path

from triquad_tools.console.command import ToolError

_READY_TIMEOUT_S = 300.0  # kernels are compiled on the first start
_STOP_TIMEOUT_S = 60.0
_POLL_S = 0.02


def free_port() -> int:
    """Return a port of the loopback that nothing uses."""
    with closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def free_endpoint() -> str:
    """Return an endpoint on such a port."""
    return f"tcp/127.0.0.1:{free_port()}"


class DemoServer:
    """A running server; leaving the ``with`` statement stops it in any case."""

    def __init__(
        self,
        folder: Path,
        map_name: str,
        arguments: Sequence[str] = (),
        endpoint: str = "",
        variables: Mapping[str, str] | None = None,
    ) -> None:
        """Start the process, with store and log in a folder, and wait until it is ready.

        ``arguments`` are further ones of its command line; without an ``endpoint`` a free one of
        the loopback is taken, and without ``variables`` the environment of this process.

        Raises:
            ToolError: it ended before, or took too long.
        """
        self.endpoint = endpoint or free_endpoint()
        self._log = folder / "server.log"
        command = [sys.executable, "-m", "triquad_server.cli", "--listen", self.endpoint]
        command += ["--map", map_name, "--store", str(folder / "store")]
        command += ["--no-multicast-scouting", *arguments]
        with self._log.open("a") as log:
            self._begins = log.tell()  # bytes, of what servers before have logged
            self._process = subprocess.Popen(command, stderr=log, env=variables)
        try:
            self._wait_until_ready()
        except BaseException:
            self._end()
            raise

    def __enter__(self) -> "DemoServer":
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def stop(self) -> None:
        """Ask the server to stop and wait for it.

        Raises:
            ToolError: it did not stop, or not in good order.
        """
        self._process.send_signal(signal.SIGTERM)
        try:
            code = self._process.wait(_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            raise ToolError(
                f"the server did not stop within {_STOP_TIMEOUT_S:g} s of SIGTERM; its log is "
                f"{self._log}"
            ) from None
        if code != 0:
            raise self._failure(f"the server stopped with exit code {code}")

    def _wait_until_ready(self) -> None:
        ends_s = time.monotonic() + _READY_TIMEOUT_S
        while " ready: " not in self._logged():
            if self._process.poll() is not None:
                raise self._failure("the server did not start")
            if time.monotonic() > ends_s:
                raise self._failure(f"the server is not ready after {_READY_TIMEOUT_S:g} s")
            time.sleep(_POLL_S)

    def _failure(self, what: str) -> ToolError:
        *_, last_line = ["it said nothing", *self._logged().splitlines()]
        return ToolError(f"{what}: {last_line}; its log is {self._log}")

    def _logged(self) -> str:
        return self._log.read_bytes()[self._begins :].decode(errors="replace")

    def _end(self) -> None:
        """Stop the process, by force where it does not react."""
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(_STOP_TIMEOUT_S)
            except BaseException:  # also a second Ctrl-C: nothing may stay behind
                self._process.kill()
                self._process.wait()
