"""A disk that is full at any byte of what a real server writes."""

import resource
from collections.abc import Iterator
from contextlib import contextmanager

import triquad_client
from support import servers
from triquad_client import RefusedError

from bench.campaign.server_under_test import (
    expect,
    expect_honest_service,
    expect_whole,
    server_under_test,
    sphere_at,
)
from bench.campaign.turn import Turn

_SPACING_M = 9.0
_PLACES = 4


def run(turn: Turn) -> None:
    """Ask for checkpoints while files can have no more than some bytes, then while they can."""
    with server_under_test(turn) as server:
        with triquad_client.connect(server.endpoint) as client:
            kept = _learn_and_keep(client, 0)
            while not turn.over:
                kept = _fill(turn, client, server.process.pid, kept)
            expect(client.status().store_error is None, "an error of the store stays")
        expect_honest_service(server.endpoint)
    left = [path.name for path in (turn.folder / "store").rglob("*.tmp")]
    expect(not left, f"unfinished files are left: {left}")


def _fill(
    turn: Turn, client: triquad_client.Client, pid: int, kept: triquad_client.CheckpointInfo
) -> triquad_client.CheckpointInfo:
    """Limit files to one size; return the checkpoint that is valid afterwards."""
    points, pose = sphere_at(turn.random.randrange(_PLACES) * _SPACING_M)
    client.publish_scan(points, pose)
    client.flush(servers.WAIT_S)
    size = turn.random.choice((0, turn.random.randrange(200), turn.random.randrange(kept.bytes)))
    with _files_of_at_most(pid, size):
        try:
            kept = client.checkpoint()
            turn.did("written all the same")
        except RefusedError as error:
            expect(error.code == "store", f"refused with {error}")
            turn.did("refused")
        # Mapping goes on.
        client.publish_scan(*sphere_at(0.0))
        client.flush(servers.WAIT_S)
    expect_whole(kept)
    return _learn_and_keep(client, turn.random.randrange(_PLACES))


def _learn_and_keep(client: triquad_client.Client, place: int) -> triquad_client.CheckpointInfo:
    client.publish_scan(*sphere_at(place * _SPACING_M))
    client.flush(servers.WAIT_S)
    kept = client.checkpoint()
    expect_whole(kept)
    return kept


@contextmanager
def _files_of_at_most(pid: int, size: int) -> Iterator[None]:
    """Let every file that the process writes end after N bytes, as on a disk that is full."""
    _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (hard, hard))
