"""SIGKILL at random moments under load: nothing that was acknowledged is lost."""

import contextlib
import threading
import time
from dataclasses import dataclass, field

import triquad_client
from triquad_client import TriquadError

from bench.campaign.server_under_test import (
    expect,
    expect_known,
    expect_none_damaged,
    server_under_test,
    sphere_at,
)
from bench.campaign.turn import Turn

_PLACES = 9  # so that the map stays small
_LATEST_KILL_S = 1.5


@dataclass
class _Acknowledged:
    """The state that the server has promised to keep."""

    epoch: int = 0
    places: set[int] = field(default_factory=set)  # where spheres are in the map


def run(turn: Turn) -> None:
    """Start, check that all is there that was acknowledged, load, kill; and again."""
    acknowledged = _Acknowledged()
    while not turn.over:
        _live_and_die(turn, acknowledged)
        turn.did("killed under load")
    with server_under_test(turn) as server, triquad_client.connect(server.endpoint) as client:
        _expect_kept(client, acknowledged)
    expect_none_damaged(turn)


def _live_and_die(turn: Turn, acknowledged: _Acknowledged) -> None:
    with server_under_test(turn, stop_status=None) as server:
        with triquad_client.connect(server.endpoint) as client:
            _expect_kept(client, acknowledged)
        checkpointed = threading.Event()
        load = threading.Thread(
            target=_load, args=(server.endpoint, turn, acknowledged, checkpointed)
        )
        load.start()
        expect(checkpointed.wait(60), "no checkpoint was acknowledged within 60 s")
        time.sleep(turn.random.uniform(0, _LATEST_KILL_S) ** 2 / _LATEST_KILL_S)
        server.process.kill()
        server.wait()
        load.join()


def _expect_kept(client: triquad_client.Client, acknowledged: _Acknowledged) -> None:
    epoch = client.status().epoch
    expect(
        epoch >= acknowledged.epoch,
        f"epoch {acknowledged.epoch} was acknowledged, but the server is back at {epoch}",
    )
    for place in acknowledged.places:
        expect_known(client, place)


def _load(
    endpoint: str, turn: Turn, acknowledged: _Acknowledged, checkpointed: threading.Event
) -> None:
    """Publish, flush, checkpoint, and record each checkpoint that is acknowledged."""
    with (
        contextlib.suppress(TriquadError),
        triquad_client.connect(endpoint, timeout_s=5.0) as client,
    ):
        while True:
            places = {turn.random.randrange(_PLACES) for _ in range(3)}
            for place in places:
                client.publish_scan(*sphere_at(place))
            report = client.flush(5.0)
            epoch = client.checkpoint().epoch
            if report.lost == report.refused == 0:
                acknowledged.places |= places
            acknowledged.epoch = max(acknowledged.epoch, epoch)
            checkpointed.set()
