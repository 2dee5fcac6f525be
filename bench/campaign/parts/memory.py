"""Too little memory: an address space that is limited, as under ``ulimit -v``."""

import contextlib
import resource
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import triquad_client
from support import servers
from triquad_client import TriquadError

from bench.campaign.server_under_test import (
    expect,
    expect_known,
    expect_none_damaged,
    publish_at,
    server_under_test,
    sphere_at,
)
from bench.campaign.turn import Turn

_PLACES = 8
_MOST_ROOM_BYTES = 48 * 2**20
_SQUEEZE_S = 3.0
_OUT_OF_MEMORY = "no more memory: mapping ends"  # what a server logs that ends for that


@dataclass
class _Kept:
    """The state that has to be there after a restart."""

    epoch: int = 0
    place: int = 0


def run(turn: Turn) -> None:
    """Limit the memory of a server under load; where it ends, start it again on its store."""
    kept = _Kept()
    while not turn.over:
        _serve_with_limits(turn, kept)
    expect_none_damaged(turn)


def _serve_with_limits(turn: Turn, kept: _Kept) -> None:
    """Run one server, until it has ended or the turn is over."""
    with server_under_test(turn, stop_status=None) as server:
        pid = server.process.pid
        with triquad_client.connect(server.endpoint, timeout_s=10.0) as client:
            epoch = client.status().epoch
            expect(epoch >= kept.epoch, f"epoch {kept.epoch} was acknowledged, {epoch} is back")
            if kept.epoch:
                expect_known(client, kept.place)
            while not turn.over:
                _keep(turn, client, kept)
                with _room(pid, int(_MOST_ROOM_BYTES * turn.random.random() ** 2)):
                    _load(turn, client)
                if server.process.poll() is not None or _OUT_OF_MEMORY in server.log:
                    server.wait()
                    turn.did("ended")
                    return
                _expect_alive(client, kept)
                turn.did("went on")


def _keep(turn: Turn, client: triquad_client.Client, kept: _Kept) -> None:
    place = turn.random.randrange(_PLACES)
    for _ in range(2):
        publish_at(client, place, source="honest")
    kept.epoch, kept.place = client.checkpoint().epoch, place


def _load(turn: Turn, client: triquad_client.Client) -> None:
    """Load the server with what takes memory; errors of triquad are allowed."""
    until = time.monotonic() + turn.random.uniform(0.2, _SQUEEZE_S)
    points = np.tile(servers.sphere(20_000), (turn.random.choice((1, 10)), 1))
    while time.monotonic() < until:
        with contextlib.suppress(TriquadError):
            place = turn.random.randrange(_PLACES)  # elsewhere it shows free space
            client.publish_scan(*sphere_at(place, 20_000))
            client.query_sdf(points)
            client.checkpoint()


def _expect_alive(client: triquad_client.Client, kept: _Kept) -> None:
    """Expect the server to map and answer as before, with memory again."""
    for _ in range(2):
        publish_at(client, kept.place, source="honest")
    expect_known(client, kept.place)


@contextlib.contextmanager
def _room(pid: int, room: int) -> Iterator[None]:
    """Let another process take some bytes more of address space at most, for a while."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[0])
        size = pages * resource.getpagesize() + room
        _, hard = resource.prlimit(pid, resource.RLIMIT_AS)
        resource.prlimit(pid, resource.RLIMIT_AS, (size, hard))
        yield
        resource.prlimit(pid, resource.RLIMIT_AS, (hard, hard))
    except ProcessLookupError:
        pass  # it has ended
