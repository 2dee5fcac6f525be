"""A whole server through the network: a server process, a lidar at 10 Hz and a planner."""

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from triquad_client import Client
from triquad_format.mapfile.reader import read_map
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings
from triquad_tools.recordings.publishing import FLUSH_TIMEOUT_S, wait_until_settled

from bench.clients.served import (
    around,
    latency_figures,
    near_surface,
    served,
    stream_beside_planner,
)
from bench.figures import Figure, seconds
from bench.parts.core import seen_points
from bench.parts.neighbours import measure_neighbours
from bench.street import bench_street
from bench.street_scores import DrivenStreet, score_street

_SOON_S = 2.0  # after the last scan
_SETTLE_LIMIT_S = 300.0
_REST_S = 12.0  # in which a server frees what it does not need
_RESTED = 11  # seconds after that in which its memory is measured
_REPEATS = 15
_ASKED = 1_000
_QUESTIONS, _FIRST = 320, 20  # the first are not counted


def measure(options: argparse.Namespace) -> list[Figure]:
    """Return figures of a whole server: what a robot would meet."""
    made = bench_street(options.seed)
    with served() as server:
        client = server.client
        met = stream_beside_planner(server, made)
        time.sleep(_SOON_S)
        name = "1,000 points with gradient while streaming"
        figures = latency_figures(name, met, median_ms=2.8, tail_ms=8) + _early(client, made)
        started = time.monotonic()
        wait_until_settled(client, _SETTLE_LIMIT_S)
        settled_s = time.monotonic() - started
        figures.append(Figure("from then until settled", settled_s, "s", at_most=300))
        figures += _idle(client, made)
        figures += _converged(client, made)
        figures += _network(client, made, server.folder)
        figures.append(Figure("resident memory right after it", _resident_mb(client), "MB"))
        resident_mb = _resident_at_rest_mb(client)
    figures.append(Figure("resident memory of the server at rest", resident_mb, "MB", at_most=380))
    return figures + measure_neighbours(made)


def _resident_mb(client: Client) -> float:
    return client.status().memory_bytes / 1e6


def _resident_at_rest_mb(client: Client) -> float:
    """Return the memory at rest, whether or not a checkpoint is being written just then."""
    time.sleep(_REST_S)
    samples = []
    for _ in range(_RESTED):
        time.sleep(1.0)
        samples.append(_resident_mb(client))
    return statistics.median(samples)


def _early(client: Client, made: DrivenStreet) -> list[Figure]:
    """Return figures of the map soon after the last scan, all from the epoch of that moment."""
    trained = client.status().samples_trained / 1e6
    mesh = client.mesh(made.drive.scene.box)
    lost = client.flush(FLUSH_TIMEOUT_S)
    scores = made.mesh_scores(mesh)
    return [
        Figure("scans dropped of 100", lost.lost + lost.refused, "", at_most=0),
        Figure("samples trained 2 s after the last scan", trained, "M"),
        Figure("then: F-score", 100 * scores.f_score, "%", at_least=99),
        Figure("then: completion ratio", 100 * scores.completion_ratio, "%", at_least=95),
    ]


def _idle(client: Client, made: DrivenStreet) -> list[Figure]:
    """Return how soon an idle server answers one question after the other."""
    place = made.drive.poses[len(made.drive.poses) // 2][:3, 3]
    points, near = around(place, _ASKED, np.random.default_rng(0)), near_surface(made)

    def typical_ms(ask: Callable[[], object]) -> float:
        return 1e3 * statistics.median([seconds(ask) for _ in range(_QUESTIONS)][_FIRST:])

    one_ms = typical_ms(lambda: client.query_sdf(near[:1], gradient=True))
    gradient_ms = typical_ms(lambda: client.query_sdf(near, gradient=True))
    distance_ms = typical_ms(lambda: client.query_distance(points))
    return [
        Figure("one point with gradient while idle, median", one_ms, "ms", at_most=0.7),
        Figure("1,000 points with gradient while idle, median", gradient_ms, "ms", at_most=1.4),
        Figure("1,000 distances to 5 m with gradient while idle, median", distance_ms, "ms",
               at_most=2.2),
    ]  # fmt: skip


def _converged(client: Client, made: DrivenStreet) -> list[Figure]:
    street = score_street(client.query_sdf, made.probes)
    started = time.perf_counter()
    mesh = client.mesh(made.drive.scene.box)
    first_s = time.perf_counter() - started
    times = [seconds(lambda: client.mesh(made.drive.scene.box)) for _ in range(3)]
    again_s = statistics.median(times)
    scores = made.mesh_scores(mesh)
    return [
        Figure("converged: F-score", 100 * scores.f_score, "%", at_least=99.8),
        Figure("converged: accuracy, mean", 100 * scores.accuracy_m, "cm", at_most=0.65),
        Figure("converged: accuracy, median", 100 * scores.accuracy_median_m, "cm"),
        Figure("converged: samples beyond 20 cm", 100 * scores.outlier_ratio, "%"),
        Figure("converged: completion", 100 * scores.completion_m, "cm"),
        Figure("converged: completion ratio", 100 * scores.completion_ratio, "%", at_least=99.8),
        Figure("converged: SDF error within 0.1 m", 100 * street.sdf_error_m, "cm", at_most=0.9),
        Figure("converged: gradient angle, median", street.gradient_angle_deg, "deg", at_most=2.5),
        Figure("houses unknown inside", 100 * street.houses_unknown_ratio, "%", at_least=99),
        Figure("mesh of the whole street, first fetched", first_s, "s", at_most=1.6),
        Figure("mesh of the whole street, fetched again", again_s, "s", at_most=1.0),
    ]


def _network(client: Client, made: DrivenStreet, folder: Path) -> list[Figure]:
    """Compare queries of 100,000 points through the network with the same map in this process."""
    client.download_map(folder / "map.triquad")
    epoch = Mapper("bench", Settings(), "cpu", record=read_map(folder / "map.triquad")).publish()
    points = seen_points(epoch, made, np.random.default_rng(0))
    times: list[float] = []
    ratios: list[float] = []
    for _ in range(_REPEATS):
        near, far = seconds(lambda: epoch.query(points)), seconds(lambda: client.query_sdf(points))
        times.append(far)
        ratios.append(near / far)
    rate = len(points) / statistics.median(times) / 1e6
    share = statistics.median(ratios)
    return [
        Figure("100,000 points through the network", rate, "M points/s"),
        Figure("the same, share of the rate in process", share, "", at_least=0.6),
    ]
