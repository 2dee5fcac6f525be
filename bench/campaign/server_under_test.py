"""A server process under test, and what an honest client may expect of it whatever happens."""

import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import triquad_client
from support import servers
from triquad_client import Status

from bench.campaign.turn import BrokenError, Turn

MAX_GROWTH_BYTES = 200 * 2**20
WITHIN_S = 30.0  # an honest request is answered, also where much else goes on
_SETTINGS = servers.SMALL_TOML + "max_regions = 40\n[store]\nkeep = 4\n"
_INTERNAL = ("Traceback", "internal error")


@contextmanager
def server_under_test(
    turn: Turn, environment: Mapping[str, str] | None = None, stop_status: int | None = 0
) -> Iterator[servers.ServerProcess]:
    """Yield a server on a store of the turn's folder; it is stopped at the end unless killed.

    ``stop_status`` is the exit status that is then expected; ``None``: it is not stopped but
    killed. Internal errors in the log break a promise.
    """
    settings = turn.folder / "server.toml"
    settings.write_text(_SETTINGS)
    arguments = ["--settings", settings, "--store", turn.folder / "store"]
    with servers.server_process(arguments, environment=environment) as server:
        try:
            yield server
            if server.process.poll() is None and stop_status is not None:
                server.process.terminate()
                expect(
                    server.wait() == stop_status,
                    f"it ended with {server.process.returncode} at SIGTERM",
                )
        finally:
            with (turn.folder / "server.log").open("a") as log:
                log.write(server.log)
    for sign in _INTERNAL:
        expect(sign not in server.log, f"the log has {sign!r}")


def expect(kept: bool, promise: str) -> None:
    """Raise :class:`BrokenError` where a promise is not kept."""
    if not kept:
        raise BrokenError(promise)


def sphere_at(x_m: float, points: int = 500) -> tuple[np.ndarray, np.ndarray]:
    """Return points of a scan in the sensor frame, and its pose on the x axis."""
    pose = np.eye(4)
    pose[0, 3] = x_m
    return servers.sphere(points), pose


def expect_known(client: triquad_client.Client, x_m: float) -> None:
    """Expect the surface of the sphere at ``x_m`` to be in the map."""
    points, pose = sphere_at(x_m, 200)
    statuses = client.query_sdf(points + pose[:3, 3]).status
    known = float((statuses == Status.SURFACE).mean())
    expect(known > 0.95, f"only {known:.0%} of the sphere at {x_m:g} m is in the map")


def expect_honest_service(endpoint: str, x_m: float = 0.0) -> None:
    """Expect a new client to publish a scan, see it in the map, and be answered in time."""
    started = time.monotonic()
    with triquad_client.connect(endpoint) as client:
        for _ in range(2):
            points, pose = sphere_at(x_m)
            client.publish_scan(points, pose, source="honest")
        report = client.flush(WITHIN_S)
        expect(report.lost == report.refused == 0, f"an honest scan is not in the map: {report}")
        expect_known(client, x_m)
        status = client.status()
        expect("internal" not in status.scans_dropped, "scans met internal errors")
        expect("internal" not in status.requests_refused, "requests met internal errors")
    expect(time.monotonic() - started < WITHIN_S, "an honest client waited too long")


def resident_bytes(pid: int) -> int:
    """Return the memory that a process has of its own in RAM."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE")


def virtual_bytes(pid: int) -> int:
    """Return the address space that a process takes."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[0])
    return pages * os.sysconf("SC_PAGESIZE")
