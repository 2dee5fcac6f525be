"""Processes that compile the kernels of a server, and give the compiler's memory back as they end.

Each goes through stages of the warm-up, in an order of its own. What one compiles is found on disk
by the others, and by the server.
"""

import json
import logging
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Collection

from triquad_map.compiled.team import lower_priority

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
_LOOK_S = 0.05  # after which whoever waits is asked whether to go on

_log = logging.getLogger(__name__)


def can_start() -> bool:
    """Whether this program can start another Python."""
    return bool(sys.executable) and not getattr(sys, "frozen", False)


class Compilers:
    """The processes; who starts them closes them."""

    def __init__(self, settings: Settings) -> None:
        self._done: set[str] = set()
        self._closed = False
        self._told: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        orders = [[stage for stage in order if not is_compiled(stage)] for order in _ORDERS]
        self._processes = [_started(order, settings) for order in orders if order]
        self._running = len(self._processes)
        for process in self._processes:
            threading.Thread(target=self._listen, args=(process,), daemon=True).start()

    def wait_for(self, stage: str, look: Callable[[], None]) -> None:
        """Wait until a stage is compiled, or will not be.

        ``look`` is called meanwhile, and may raise what ends the waiting.
        """
        while self._running and stage not in self._done and not is_compiled(stage):
            look()
            try:
                done = self._told.get(timeout=_LOOK_S)
            except queue.Empty:
                continue
            if done is None:
                self._running -= 1
            else:
                self._done.add(done)

    def close(self) -> None:
        """End the processes, whatever they are at."""
        self._closed = True
        for process in self._processes:
            process.kill()
            process.wait()

    def _listen(self, process: "subprocess.Popen[str]") -> None:
        assert process.stdout is not None
        with process.stdout:
            for line in process.stdout:
                self._told.put(line.strip())
        if process.wait() != 0 and not self._closed:
            _log.warning("a process that compiled has failed: this one compiles what is missing")
        self._told.put(None)


def _started(order: Collection[str], settings: Settings) -> "subprocess.Popen[str]":
    process = subprocess.Popen(
        [sys.executable, "-I", "-c", _CODE, json.dumps(sys.path), *order],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,  # Ctrl-C is not for it
    )
    assert process.stdin is not None
    with process.stdin:
        process.stdin.write(settings.model_dump_json())
    return process


def compile_stages(stages: Collection[str]) -> None:
    """In a process of its own: go through ``stages``, and print each once it is compiled."""
    lower_priority(NICENESS)
    put_off_collection()  # a sixth of the time
    logging.disable(logging.WARNING)  # the server has said what goes on
    settings = Settings.model_validate_json(sys.stdin.read())
    made_up = WarmUp(settings, "cpu", Teams())
    for stage in stages:
        made_up.go_through(stage)
        print(stage, flush=True)  # noqa: T201 - to the server
