"""A server process under test, and what an honest client may expect of it whatever happens."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import triquad_client
from support import servers
from triquad_client import FlushReport, Status
from triquad_format.mapfile.reader import read_map

from bench.campaign.turn import BrokenError, Turn

_SPACING_M = 9.0  # between places on the x axis, each with a sphere of its own
_MAX_GROWTH_BYTES = 200 * 2**20
WITHIN_S = 30.0  # an honest request is answered, also where much else goes on
_SETTINGS = servers.SMALL_FILE.read_text() + "max_regions = 40\n[store]\nkeep = 4\n"
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


@contextmanager
def learnt_server(turn: Turn) -> Iterator[servers.ServerProcess]:
    """Yield a server that has learnt a sphere about the origin; it is stopped at the end."""
    with server_under_test(turn) as server:
        with triquad_client.connect(server.endpoint) as client:
            servers.learn(client)
        yield server


def sphere_at(place: int, points: int = 500) -> tuple[np.ndarray, np.ndarray]:
    """Return points of a scan in the sensor frame, and its pose at a place on the x axis."""
    pose = np.eye(4)
    pose[0, 3] = place * _SPACING_M
    return servers.sphere(points), pose


def publish_at(client: triquad_client.Client, place: int, **options: str) -> FlushReport:
    """Publish a scan of the sphere at a place, and wait until it is in the map."""
    client.publish_scan(*sphere_at(place), **options)
    return client.flush(servers.WAIT_S)


def expect_known(client: triquad_client.Client, place: int) -> None:
    """Expect the surface of the sphere at a place to be in the map."""
    points, pose = sphere_at(place, 200)
    statuses = client.query_sdf(points + pose[:3, 3]).status
    known = float((statuses == Status.SURFACE).mean())
    expect(known > 0.95, f"only {known:.0%} of the sphere at place {place} is in the map")


def expect_honest_service(endpoint: str, place: int = 0) -> None:
    """Expect a new client to publish a scan, see it in the map, and be answered in time."""
    started = time.monotonic()
    with triquad_client.connect(endpoint) as client:
        for _ in range(2):
            client.publish_scan(*sphere_at(place), source="honest")
        report = client.flush(WITHIN_S)
        expect(report.lost == report.refused == 0, f"an honest scan is not in the map: {report}")
        expect_known(client, place)
        status = client.status()
        expect("internal" not in status.scans_dropped, "scans met internal errors")
        expect("internal" not in status.requests_refused, "requests met internal errors")
    expect(time.monotonic() - started < WITHIN_S, "an honest client waited too long")


def expect_steady_memory(turn: Turn, before: int, after: int) -> None:
    """Expect a server to take hardly more bytes than before."""
    turn.measured("growth MB", (after - before) / 2**20)
    expect(after - before < _MAX_GROWTH_BYTES, f"memory grew from {before} to {after} bytes")


def checkpoint(client: triquad_client.Client) -> triquad_client.CheckpointInfo:
    """Have a checkpoint written, and expect it to be what is acknowledged."""
    kept = client.checkpoint()
    expect_whole(kept)
    return kept


def expect_whole(kept: triquad_client.CheckpointInfo) -> None:
    """Expect a checkpoint to be what was acknowledged."""
    expect(Path(kept.path).exists(), f"{kept.path} was acknowledged and is gone")
    expect(read_map(kept.path).epoch == kept.epoch, f"{kept.path} is another")


def expect_none_damaged(turn: Turn) -> None:
    """Expect that no server of the turn took a checkpoint for damaged."""
    aside = [path.name for path in (turn.folder / "store").rglob("*.damaged")]
    expect(not aside, f"checkpoints were taken for damaged: {aside}")
