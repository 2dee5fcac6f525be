"""A robot's planner in the demonstration: a process that asks for distances repeatedly."""

import multiprocessing
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from multiprocessing.connection import Connection

import numpy as np
from triquad_client import Client, connect
from triquad_format.errors import TriquadError
from triquad_format.records.arrays import Doubles

_PERIOD_S = 0.05
_STOP_TIMEOUT_S = 60.0


_QUESTIONS: dict[str, Callable[[Client, Doubles], int]] = {
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
        """Start to ask at points [N, 3], some 20 times a second."""
        processes = multiprocessing.get_context("spawn")  # a fork would share the parent's session
        self._connection, theirs = processes.Pipe()
        arguments = (theirs, endpoint, map_name, points, question)
        self._process = processes.Process(target=_ask, args=arguments)
        self._process.start()
        theirs.close()

    def __enter__(self) -> "Probe":
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.join()
        self._connection.close()

    def finish(self) -> ProbeReport:
        """End the queries and return what they met.

        Raises:
            TriquadError: the process failed.
        """
        try:
            self._connection.send(None)
            if not self._connection.poll(_STOP_TIMEOUT_S):
                raise TriquadError(f"the queries did not end within {_STOP_TIMEOUT_S:g} s")
            report: ProbeReport = self._connection.recv()
        except (EOFError, ConnectionError):
            self._process.join()
            code = self._process.exitcode
            raise TriquadError(f"the queries ended with exit code {code}") from None
        return report


def _ask(parent: Connection, endpoint: str, map_name: str, points: Doubles, question: str) -> None:
    """Ask until the parent process sends something or has ended, and send it the report."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    latencies_s: list[float] = []
    epochs: list[int] = []
    errors, last_error, wait_s = 0, None, 0.0
    with connect(endpoint, map_name) as client:
        while not parent.poll(max(wait_s, 0.0)):
            started = time.perf_counter()
            try:
                epochs.append(_QUESTIONS[question](client, points))
                latencies_s.append(time.perf_counter() - started)
            except TriquadError as error:
                errors += 1
                last_error = f"{type(error).__name__}: {error}"
            wait_s = _PERIOD_S - (time.perf_counter() - started)
    p50, p99, longest = 1e3 * np.quantile(latencies_s or [np.nan], [0.5, 0.99, 1.0])
    parent.send(
        ProbeReport(
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
    )
