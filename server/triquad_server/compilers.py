"""Processes that compile the kernels of a server, and give the compiler's memory back as they end.

Each goes through stages of the warm-up, in an order of its own. What one compiles is found on disk
by the others, and by the server.
"""

import json
import logging
import os
import subprocess
import sys
import time
from collections.abc import Callable, Collection

from triquad_map.compiled.priority import lower_priority

from triquad_server.process.memory import put_off_collection
from triquad_server.process.threads import NICENESS, Teams
from triquad_server.settings import Settings
from triquad_server.warm_up import WarmUp, is_compiled

_ORDERS = (
    ("field", "questions", "steps", "normals", "taking_back", "meshes"),
    ("surfels", "questions", "scans", "training", "what_is_gone"),
)
"""What each process goes through: kernels that answer first, then those that map; halves apart."""

_CODE = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from triquad_server.compilers import compile_stages; compile_stages(sys.argv[2:])"
)
_LOOK_S = 0.05  # between two looks whether a stage is compiled

_log = logging.getLogger(__name__)


def can_start() -> bool:
    """Whether this program can start another Python."""
    return bool(sys.executable) and not getattr(sys, "frozen", False)


class Compilers:
    """The processes; who starts them closes them."""

    def __init__(self, settings: Settings) -> None:
        orders = [[stage for stage in order if not is_compiled(stage)] for order in _ORDERS]
        self._processes = [_started(order, settings) for order in orders if order]

    def wait_for(self, stage: str, look: Callable[[], None]) -> None:
        """Wait until a stage is compiled, or will not be.

        ``look`` is called meanwhile, and may raise what ends the waiting.
        """
        while not is_compiled(stage):
            if all(process.poll() is not None for process in self._processes):
                _log.warning("the processes that compile have failed: this one does it")
                return
            look()
            time.sleep(_LOOK_S)

    def close(self) -> None:
        """End the processes, whatever they are at."""
        for process in self._processes:
            process.kill()
            process.wait()


def _started(order: Collection[str], settings: Settings) -> "subprocess.Popen[str]":
    process = subprocess.Popen(
        [sys.executable, "-I", "-c", _CODE, json.dumps(sys.path), *order],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,  # what cannot be compiled, the server itself fails at and tells
        text=True,
        start_new_session=True,  # Ctrl-C is not for it
    )
    assert process.stdin is not None
    with process.stdin:
        process.stdin.write(settings.model_dump_json())
    return process


def compile_stages(stages: Collection[str]) -> None:
    """In a process of its own: go through ``stages``, for as long as the server is there."""
    server = os.getppid()
    lower_priority(NICENESS)
    put_off_collection()  # a sixth of the time
    made_up = WarmUp(Settings.model_validate_json(sys.stdin.read()), "cpu", Teams())
    for stage in stages:
        if os.getppid() != server:
            return
        made_up.go_through(stage)
