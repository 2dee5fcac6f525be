"""A server's start: with nothing compiled, and later."""

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np
from triquad_client import connect
from triquad_format.records.arrays import Floats

from bench.clients.served import MAP
from bench.clients.server_process import server_process
from bench.figures import Figure

_STARTS = 5
_LAUNCHES = 50
_TIMEOUT_S = 300.0


def measure(_: argparse.Namespace) -> list[Figure]:
    """Return how soon a server answers and integrates a scan, and its memory by then."""
    with tempfile.TemporaryDirectory(prefix="triquad-bench-") as name:
        first = _Start(Path(name))
        later = [_Start(Path(name)) for _ in range(_STARTS)]
        launched_s = [_launched_s(Path(name)) for _ in range(_LAUNCHES)]
    ready_s = statistics.median(start.ready_s for start in later)
    return [
        Figure("ready at the very first start", first.ready_s, "s", at_most=45),
        Figure("a scan is taken in then, after", first.mapping_s, "s"),
        Figure("resident memory after it", first.resident_mb, "MB"),
        Figure("ready at a later start", ready_s, "s", at_most=2),
        Figure("resident memory after that", later[-1].resident_mb, "MB"),
        Figure("connected, of 50 clients started with their servers", len(launched_s), ""),
        Figure("the last of them, after", max(launched_s), "s"),
    ]


def _launched_s(folder: Path) -> float:
    """Return when a client that was started together with its server was connected, seconds.

    Raises:
        TriquadError: it was not, within the time that clients wait by default.
    """
    started = time.monotonic()
    compiled = {"NUMBA_CACHE_DIR": str(folder / "kernels")}
    with (
        server_process(["--device", "cpu"], environment=compiled, ready=False) as server,
        connect(server.endpoint) as client,
    ):
        client.status()
        return time.monotonic() - started


class _Start:
    """A start of a server with an empty map, which ends again."""

    def __init__(self, folder: Path) -> None:
        """Start a server whose compiled code is kept in a folder."""
        compiled = {"NUMBA_CACHE_DIR": str(folder / "kernels")}
        started = time.monotonic()
        with server_process(["--map", MAP, "--device", "cpu"], environment=compiled) as server:
            self.ready_s = time.monotonic() - started
            with connect(server.endpoint, MAP, timeout_s=_TIMEOUT_S) as client:
                client.publish_scan(_sphere(), np.eye(4))
                client.flush(_TIMEOUT_S)
                self.mapping_s = time.monotonic() - started
                self.resident_mb = client.status().memory_bytes / 1e6


def _sphere() -> Floats:
    """Return points [N, 3] around a sensor, metres."""
    directions = np.random.default_rng(0).normal(size=(1000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return (3 * directions).astype(np.float32)
