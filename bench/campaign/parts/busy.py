"""SIGKILL while other programs keep all cores busy: hardly more is lost than two periods."""

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import triquad_client
from support import servers
from triquad_client import TriquadError
from triquad_server.settings import Settings
from triquad_server.store.store import Store
from triquad_tools.simulation.lidar import SimulatedScan
from triquad_tools.simulation.street import street_drive

from bench.campaign.server_under_test import expect
from bench.campaign.turn import Turn

_PERIOD_S = 5.0
_BOUND_S = 2 * _PERIOD_S
_LIVES_S = 30.0  # at most, before the kill
_BUSY = 2
_SCANS = 100
_SCAN_S = 0.1


@dataclass
class _Watched:
    """The moments, monotonic, at which the server was seen to have an epoch for the first time."""

    first_seen_s: dict[int, float] = field(default_factory=dict)
    warned: bool = False  # that more is unsaved than there may be


def run(turn: Turn) -> None:
    """Drive along a street, kill the server at a random moment, and see what its store has."""
    scans = list(street_drive(turn.seed, _SCANS))
    with _busy_processes():
        while not turn.over:
            store = turn.folder / f"store-{turn.counts['done']}"
            lost_s, warned = _life(scans, store, turn.random.uniform(0, _LIVES_S))
            turn.measured("lost, s", lost_s)
            expect(warned or lost_s <= _BOUND_S, f"{lost_s:.1f} s are lost, without a warning")
            turn.did("within two periods" if lost_s <= _BOUND_S else "more, and warned of")


def _life(scans: list[SimulatedScan], store: Path, lives_s: float) -> tuple[float, bool]:
    """Return how many seconds of the map a kill took, and whether the server had warned."""
    watched, over = _Watched(), threading.Event()
    settings = ["--store", store, "--set", f"store.period_s={_PERIOD_S}"]
    with servers.server_process(settings) as server:
        watcher = threading.Thread(target=_watch, args=(server.endpoint, watched, over))
        watcher.start()
        with triquad_client.connect(server.endpoint) as client:
            ends_s = time.monotonic() + _BOUND_S + lives_s
            number = 0
            while time.monotonic() < ends_s:
                scan = scans[number % len(scans)]
                client.publish_scan(scan.points, scan.world_from_sensor)
                number += 1
                over.wait(_SCAN_S)
        killed_s = time.monotonic()
        server.process.kill()
        server.wait()
        over.set()
        watcher.join()
    newest = Store(store, servers.MAP, Settings().store).newest()
    kept = newest.info.epoch if newest else 0
    later = [seen_s for epoch, seen_s in watched.first_seen_s.items() if epoch > kept]
    return killed_s - min(later, default=killed_s), watched.warned


def _watch(endpoint: str, watched: _Watched, over: threading.Event) -> None:
    with suppress(TriquadError), triquad_client.connect(endpoint) as client:
        while not over.wait(_SCAN_S):
            status = client.status()
            watched.first_seen_s.setdefault(status.epoch, time.monotonic())
            watched.warned |= "checkpoints are late" in " ".join(status.warnings)


@contextmanager
def _busy_processes() -> Iterator[None]:
    command = [sys.executable, "-c", "while True: pass"]
    busy = [subprocess.Popen(command) for _ in range(_BUSY)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()
