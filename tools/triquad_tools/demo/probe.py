"""A robot's planner in the demonstration: a process that asks for distances repeatedly.

It asks for the same points some 20 times a second, until its standard input ends; then it prints
what it met, as JSON.
"""

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise

import numpy as np
from triquad_client import Client, connect
from triquad_format.errors import TriquadError
from triquad_format.records.arrays import Doubles

from triquad_tools.console.command import ToolError
from triquad_tools.console.lines import print_line

PERIOD_S = 0.05
_STOP_TIMEOUT_S = 60.0


QUESTIONS: dict[str, Callable[[Client, Doubles], int]] = {
    "sdf": lambda client, points: client.query_sdf(points).epoch,
    "gradient": lambda client, points: client.query_sdf(points, gradient=True).epoch,
    "distance": lambda client, points: client.query_distance(points).epoch,
    "ground": lambda client, points: client.query_ground(points).epoch,
}
"""The questions of the planner; each returns the epoch that answered."""


@dataclass(frozen=True)
class ProbeReport:
    """The results of the planner; latencies are NaN if no query was answered."""

    queries: int
    errors: int
    last_error: str | None
    epochs: int  # different ones that answered
    epochs_backwards: int  # answers from an older epoch than the one before
    points: int  # of one query
    latency_p50_ms: float
    latency_p99_ms: float
    latency_max_ms: float


class Probe:
    """The planner's process; leaving the ``with`` statement ends it in any case."""

    def __init__(
        self, endpoint: str, map_name: str, points: Doubles, question: str = "sdf"
    ) -> None:
        """Start to ask a question of ``QUESTIONS`` at points [N, 3], a few thousand at most."""
        command = [sys.executable, "-m", __name__, endpoint, map_name, question, str(len(points))]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert self._process.stdin is not None
        self._process.stdin.write(points.astype("<f8").tobytes())
        self._process.stdin.flush()

    def __enter__(self) -> "Probe":
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.__exit__(None, None, None)

    def finish(self) -> ProbeReport:
        """End the queries and return what they met.

        Raises:
            ToolError: the process failed.
        """
        try:
            output, _ = self._process.communicate(timeout=_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            raise ToolError(f"the queries did not end within {_STOP_TIMEOUT_S:g} s") from None
        if self._process.returncode != 0:
            raise ToolError(f"the queries ended with exit code {self._process.returncode}")
        return ProbeReport(**json.loads(output))


def ask_until(
    stop: threading.Event, client: Client, points: Doubles, question: str = "sdf"
) -> ProbeReport:
    """Ask a question of ``QUESTIONS`` at ``points`` [N, 3] until ``stop`` is set."""
    latencies_s: list[float] = []
    epochs: list[int] = []
    errors = 0
    last_error = None
    while not stop.is_set():
        started = time.perf_counter()
        try:
            epochs.append(QUESTIONS[question](client, points))
            latencies_s.append(time.perf_counter() - started)
        except TriquadError as error:
            errors += 1
            last_error = f"{type(error).__name__}: {error}"
        stop.wait(PERIOD_S - (time.perf_counter() - started))
    p50, p99, longest = 1e3 * np.quantile(latencies_s or [np.nan], [0.5, 0.99, 1.0])
    return ProbeReport(
        queries=len(latencies_s) + errors,
        errors=errors,
        last_error=last_error,
        epochs=len(set(epochs)),
        epochs_backwards=sum(later < before for before, later in pairwise(epochs)),
        points=len(points),
        latency_p50_ms=float(p50),
        latency_p99_ms=float(p99),
        latency_max_ms=float(longest),
    )


def main(argv: Sequence[str]) -> int:
    """Run the process; ``argv`` is endpoint, map, question and how many points are read."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    endpoint, map_name, question, count = argv
    points = np.frombuffer(sys.stdin.buffer.read(24 * int(count)), "<f8").reshape(-1, 3)
    stop = threading.Event()

    def wait_for_end() -> None:
        sys.stdin.buffer.read()
        stop.set()

    threading.Thread(target=wait_for_end, daemon=True).start()
    with connect(endpoint, map_name) as client:
        report = ask_until(stop, client, points, question=question)
    print_line(json.dumps(asdict(report)))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
