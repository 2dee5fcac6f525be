"""The effect of clients that want too much on a planner and a lidar."""

from collections.abc import Sequence
from contextlib import ExitStack

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_tools.demo.probe import ProbeReport

from bench.clients.noisy_neighbours import frozen_neighbours, neighbour
from bench.clients.served import MAP, Served, around, latency_figures, served, stream
from bench.figures import Figure
from bench.street_scores import DrivenStreet

_ASKED = 1_000
_WARM_SCANS = 20
_TAIL_MS = 50.0
_LOST_SHARE = 0.01
_SETTLE_S = 600.0


def measure_neighbours(made: DrivenStreet) -> list[Figure]:
    """Return figures of a planner at 20 Hz and a lidar at 10 Hz, alone and with neighbours."""
    place = made.drive.poses[len(made.drive.poses) // 2][:3, 3]
    points = around(place, _ASKED, np.random.default_rng(0))
    with served() as server:
        stream(server.client, made.scans[:_WARM_SCANS], "streaming alone at first")
        alone = _measure(server, made, points, kinds=())
        beside = _measure(server, made, points, kinds=("greedy", "unread", "flood"))
    return _figures("alone", alone) + _figures("beside neighbours", beside)


def _measure(
    server: Served, made: DrivenStreet, points: Doubles, kinds: Sequence[str]
) -> tuple[ProbeReport, int, int]:
    """Return a planner's figures while a lidar streams, the scans, and how many were lost."""
    with ExitStack() as stack:
        for kind in kinds:
            if kind == "unread":
                stack.enter_context(frozen_neighbours(server.endpoint, MAP))
            else:
                stack.enter_context(neighbour(kind, server.endpoint, MAP))
        lidar = stack.enter_context(server.another_client())
        probe = stack.enter_context(server.planner(points, "distance"))
        stream(lidar, made.scans, f"streaming beside {', '.join(kinds) or 'a planner'}")
        met = probe.finish()
        fate = lidar.flush(_SETTLE_S)
    return met, len(made.scans), fate.lost


def _figures(name: str, measured: tuple[ProbeReport, int, int]) -> list[Figure]:
    met, scans, lost = measured
    figures = latency_figures(f"planner {name}", met, tail_ms=_TAIL_MS)
    lost_at_most = _LOST_SHARE * scans
    return [
        *figures,
        Figure(f"lidar {name}, lost of {scans} scans", lost, "", at_most=lost_at_most),
    ]
