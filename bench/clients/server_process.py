"""A ``triquad-server`` as a process of its own, as robots have it."""

import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path

_READY_TIMEOUT_S = 300.0  # kernels are compiled on the first start
_POLL_S = 0.02


class ServerProcess:
    """A running server; leaving the ``with`` statement stops it."""

    def __init__(
        self,
        folder: Path,
        map_name: str,
        arguments: Sequence[str] = (),
        variables: Mapping[str, str] | None = None,
    ) -> None:
        """Start the process, with store and log in a folder, and wait until it is ready.

        ``arguments`` are further ones of its command line; without ``variables`` it has the
        environment of this process.

        Raises:
            RuntimeError: it ended before, or took too long.
        """
        with closing(socket.socket()) as probe:
            probe.bind(("127.0.0.1", 0))
            self.endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        command = [sys.executable, "-m", "triquad_server.cli", "--listen", self.endpoint]
        command += ["--map", map_name, "--store", str(folder / "store")]
        command += ["--no-multicast-scouting", *arguments]
        self._log = folder / "server.log"
        with self._log.open("w") as log:
            self._process = subprocess.Popen(command, stderr=log, env=variables)
        try:
            self._wait_until_ready()
        except BaseException:
            self._end()
            raise

    def __enter__(self) -> "ServerProcess":
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def _wait_until_ready(self) -> None:
        ends_s = time.monotonic() + _READY_TIMEOUT_S
        while " ready: " not in self._log.read_text():
            if self._process.poll() is not None or time.monotonic() > ends_s:
                raise RuntimeError(f"the server did not start: {self._log.read_text()}")
            time.sleep(_POLL_S)

    def _end(self) -> None:
        self._process.terminate()
        try:
            self._process.wait()
        except BaseException:  # Ctrl-C: nothing may stay behind
            self._process.kill()
            raise
