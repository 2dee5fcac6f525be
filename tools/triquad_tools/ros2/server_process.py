"""A ``triquad-server`` that runs for the bridge, and is the router of the ROS nodes."""

import argparse
import ctypes
import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from triquad_format.wire.endpoints import DEFAULT_ENDPOINT, full_endpoint
from triquad_format.wire.keys import DEFAULT_MAP
from triquad_format.wire.zenoh_access import (
    access_control,
    take_part_in_ros2,
    without_credentials,
)

from triquad_tools.ros2.options import TopicChoice
from triquad_tools.ros2.topics import bridge_key

_PR_SET_PDEATHSIG = 1  # of prctl(2)


class ServerProcess:
    """A running server; leaving the ``with`` statement stops it, and waits for its checkpoint."""

    def __init__(self, arguments: Sequence[str], topics: TopicChoice) -> None:
        """Start a server with the arguments of its command line.

        Unless they name a Zenoh configuration, nodes find each other by it, and those beyond this
        machine may take part in the domain of the ``topics``.
        """
        given = _parsed(arguments)
        self.map_name: str = given.map[0] if given.map else DEFAULT_MAP
        # Where it listens on 0.0.0.0, connecting to that reaches it on this machine.
        self.endpoint = full_endpoint(given.listen[0] if given.listen else DEFAULT_ENDPOINT)
        self._folder = TemporaryDirectory(prefix="triquad-ros2-")
        command = [sys.executable, "-m", "triquad_server.cli", *arguments]
        if given.config is None:
            file = Path(self._folder.name) / "zenoh.json5"
            file.write_text(_network(topics))
            command += ["--config", str(file)]
        # A service manager may watch this process; it is the server that reports its state.
        environment = {key: value for key, value in os.environ.items() if key != "WATCHDOG_PID"}
        # The system stops the server if the bridge is killed: it would occupy the port.
        end_with_parent = partial(ctypes.CDLL(None).prctl, _PR_SET_PDEATHSIG, signal.SIGTERM)
        self._process = subprocess.Popen(command, env=environment, preexec_fn=end_with_parent)

    def __enter__(self) -> "ServerProcess":
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        while self.exit_code is None:  # however often Ctrl-C is pressed: a checkpoint is written
            with suppress(KeyboardInterrupt):
                self._process.wait()
        self._folder.cleanup()

    @property
    def exit_code(self) -> int | None:
        """The status with which it has ended; None: it runs."""
        return self._process.poll()

    def wait(self, timeout_s: float | None = None) -> None:
        """Return once it has ended, or after some time."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout_s)


def _parsed(arguments: Sequence[str]) -> argparse.Namespace:
    """Return what the bridge has to know of the server's arguments."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--map", action="append")
    parser.add_argument("-l", "--listen", action="append")
    parser.add_argument("-c", "--config")
    return parser.parse_known_args(arguments)[0]


def _network(topics: TopicChoice) -> str:
    published = [bridge_key(topics.mesh), bridge_key(topics.grid)]
    rules = take_part_in_ros2(topics.domain, published)
    configuration = {
        "scouting": {"gossip": {"enabled": True}},  # nodes find each other through it
        "access_control": access_control(without_credentials(ros2=rules)),
    }
    return json.dumps(configuration)
