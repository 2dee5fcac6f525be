"""Two maps in one server, each with a lidar at 5 Hz; and each of them in a server of its own."""

import argparse
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

from triquad_client import Client, connect
from triquad_tools.recordings.publishing import wait_until_settled
from triquad_tools.simulation.lidar import Lidar
from triquad_tools.simulation.street import street_drive

from bench.clients.server_process import server_process
from bench.driven import Driven, driven
from bench.figures import Figure

_NAMES = ("first", "second")
_SCANS, _LENGTH_M, _RATE_HZ = 100, 60.0, 5.0
_VOXEL_M = 0.05
_TIMEOUT_S, _SETTLED_S = 60.0, 600.0


def measure(options: argparse.Namespace) -> list[Figure]:
    """Return how two maps are learnt apart, and together."""
    step_m = _LENGTH_M / _SCANS
    streets = [
        driven(street_drive(options.seed + n, _SCANS, step_m, _LENGTH_M, Lidar()), _VOXEL_M, name)
        for n, name in enumerate(_NAMES)
    ]
    figures = []
    alone = [_served([name], [street]) for name, street in zip(_NAMES, streets, strict=True)]
    together = _served(_NAMES, streets)
    for number, name in enumerate(_NAMES):
        (apart,), shared = alone[number], together[number]
        figures += [
            Figure(f"{name} map alone: F when the scans end", 100 * apart.f_driven, "%"),
            Figure("of two", 100 * shared.f_driven, "%"),
            Figure("alone: F once it has settled", 100 * apart.f_settled, "%"),
            Figure("of two: less", 100 * (apart.f_settled - shared.f_settled), "points",
                   at_most=0.2),
            Figure("of two: scans not taken", shared.lost, "", at_most=0),
        ]  # fmt: skip
    return figures


class _Learnt:
    """How a map was learnt."""

    def __init__(self, client: Client, street: Driven) -> None:
        """Publish the scans of a street, as a lidar does, and score the map."""
        started_s = time.monotonic()
        for number, scan in enumerate(street.scans):
            time.sleep(max(0.0, started_s + number / _RATE_HZ - time.monotonic()))
            client.publish_scan(scan.points, scan.world_from_sensor, no_return=scan.no_return)
        report = client.flush(_TIMEOUT_S)
        self.lost = len(street.scans) - report.taken
        box = street.drive.scene.box
        self.f_driven = street.mesh_scores(client.mesh(box)).f_score
        wait_until_settled(client, _SETTLED_S)
        self.f_settled = street.mesh_scores(client.mesh(box)).f_score


def _served(names: Sequence[str], streets: Sequence[Driven]) -> list[_Learnt]:
    """Learn maps in one server, all at the same time."""
    words = [word for name in names for word in ("--map", name)]
    with (
        server_process(words) as server,
        ExitStack() as stack,
        ThreadPoolExecutor(len(names)) as threads,
    ):
        clients = [
            stack.enter_context(connect(server.endpoint, name, timeout_s=_TIMEOUT_S))
            for name in names
        ]
        return list(threads.map(_Learnt, clients, streets))
