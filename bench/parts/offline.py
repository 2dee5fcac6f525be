"""Maps opened offline: how true and fast their answers are compared to the server's epoch."""

from pathlib import Path

import numpy as np
from triquad_client import OfflineMap, open_map
from triquad_format.records.arrays import Doubles
from triquad_map.questions.distance import distances
from triquad_server.epochs.epoch import Epoch

from bench.figures import Figure, compare, seconds
from bench.parts.core import seen_points
from bench.street_scores import DrivenStreet

_SEED = 4  # of the points at which both are asked
_ROUNDS = 7
_MANY, _FEW = 100_000, 1_000


def measure_offline(made: DrivenStreet, epoch: Epoch, path: Path) -> list[Figure]:
    """Return figures of the street's map in a file, against the epoch that it was written of."""
    points = seen_points(epoch, made, np.random.default_rng(_SEED))
    open_map(path).query_distance(points[:10])  # compiled code is loaded
    opening_s = seconds(lambda: open_map(path))
    with open_map(path) as offline:
        first_s = seconds(lambda: offline.query_distance(points[:1]))
        figures = _differences(offline, epoch, points)
        figures += _ratios(offline, epoch, points[:_FEW], repeats=20)
        figures += _ratios(offline, epoch, points[:_MANY], repeats=2)
    return [
        *figures,
        Figure("open the file of the street", opening_s, "s", at_most=2),
        Figure("the first distance, with fitting all surfels", first_s, "s", at_most=2),
    ]


def _differences(offline: OfflineMap, epoch: Epoch, points: Doubles) -> list[Figure]:
    field, live_field = offline.query_sdf(points), epoch.query(points)
    have, want = offline.query_distance(points), distances(epoch, points)
    sdf_m = np.quantile(np.abs(field.sdf - live_field.sdf), 0.99)
    distance_m = np.quantile(np.abs(have.distance_m - want.distance_m), 0.99)
    equal = np.mean((field.status == live_field.status) & (have.status == want.status))
    return [
        Figure("offline against live, SDF, 99 %", 1e3 * float(sdf_m), "mm", at_most=1),
        Figure("offline against live, distance, 99 %", 1e3 * float(distance_m), "mm", at_most=1),
        Figure("equal status", 100 * float(equal), "%", at_least=99.99),
        Figure("found alike", 100 * float(np.mean(have.found == want.found)), "%", at_least=99.9),
    ]


def _ratios(offline: OfflineMap, epoch: Epoch, points: Doubles, repeats: int) -> list[Figure]:
    """Return how many times as long as the server's epoch the file takes."""
    sdf = compare(lambda: offline.query_sdf(points), lambda: epoch.query(points), _ROUNDS, repeats)
    distance = compare(
        lambda: offline.query_distance(points),
        lambda: distances(epoch, points),
        _ROUNDS,
        repeats,
    )
    return [
        Figure(f"{len(points):,} {name}, times the server's epoch", 1 / one.ratio, "", at_most=1.2)
        for name, one in (("SDF", sdf), ("distances", distance))
    ]
