"""A disk that is full at any byte of what a real server writes."""

import resource
from collections.abc import Iterator
from contextlib import contextmanager

import triquad_client
from triquad_client import RefusedError

from bench.campaign.server_under_test import (
    checkpoint,
    expect,
    expect_honest_service,
    expect_whole,
    publish_at,
    server_under_test,
)
from bench.campaign.turn import Turn

_PLACES = 4


def run(turn: Turn) -> None:
    """Ask for checkpoints while files can have no more than some bytes, then while they can."""
    with server_under_test(turn) as server:
        with triquad_client.connect(server.endpoint) as client:
            publish_at(client, 0)
            kept = checkpoint(client)
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
    publish_at(client, turn.random.randrange(_PLACES))
    size = turn.random.choice((0, turn.random.randrange(200), turn.random.randrange(kept.bytes)))
    with _files_of_at_most(pid, size):
        try:
            kept = client.checkpoint()
            turn.did("written all the same")
        except RefusedError as error:
            expect(error.code == "store", f"refused with {error}")
            turn.did("refused")
        publish_at(client, 0)  # mapping goes on
    expect_whole(kept)
    publish_at(client, turn.random.randrange(_PLACES))
    return checkpoint(client)


@contextmanager
def _files_of_at_most(pid: int, size: int) -> Iterator[None]:
    """Let every file that the process writes end after N bytes, as on a disk that is full."""
    _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (hard, hard))
