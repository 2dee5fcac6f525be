"""Planners: one, and sixteen at once while a lidar streams."""

import argparse
import statistics
import time
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial

import numpy as np
from triquad_format.mapfile.reader import read_map
from triquad_format.records.arrays import Doubles
from triquad_map.questions.distance import distances
from triquad_map.view import MapView
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings
from triquad_tools.demo.probe import ProbeReport
from triquad_tools.recordings.publishing import FLUSH_TIMEOUT_S, wait_until_settled

from bench.clients.served import MAP, Served, around, latency_figures, served, stream
from bench.figures import Figure, seconds
from bench.parts.ground import ground_latency, ground_points, measure_ground
from bench.street import bench_street
from bench.street_scores import DrivenStreet
from bench.truths import REACH_M, measure_answers

_ASKED = 1_000
_ASKED_AT_ONCE = 100_000
_ROUNDS = 5
_CLIENTS = 16
_SETTLE_LIMIT_S = 600.0
_WARM_S = 3.0  # until sixteen processes have started


def measure(options: argparse.Namespace) -> list[Figure]:
    """Return figures of answers, and of how soon they come."""
    made = bench_street(options.seed)
    with served() as server:
        points = _planner_points(made, _ASKED)
        figures = _one(server, made, points[0])
        figures += _sixteen(server, made, points)
        wait_until_settled(server.client, _SETTLE_LIMIT_S)
        figures += ground_latency(server, ground_points(made))
        server.client.download_map(server.folder / "map.triquad")
        record = read_map(server.folder / "map.triquad")
    view = Mapper(MAP, Settings(), "cpu", record=record).publish()
    figures = _in_process(made, view) + figures
    return measure_answers(made, record, view) + measure_ground(made, view) + figures


def _in_process(made: DrivenStreet, view: MapView) -> list[Figure]:
    """Return how soon distances are known, without a network and while nothing else is done."""

    def typical_s(asked: Sequence[Doubles]) -> float:
        distances(view, asked[0], REACH_M)
        times = [seconds(partial(distances, view, each, REACH_M)) for each in asked]
        return statistics.median(times)

    few = _planner_points(made, _ASKED)
    many = np.concatenate(_planner_points(made, _ASKED_AT_ONCE // _CLIENTS))
    many = np.random.default_rng(0).permutation(many)
    rate = len(many) / typical_s([many] * _ROUNDS) / 1e6
    return [
        Figure(f"{_ASKED} distances to {REACH_M:g} m with gradient, in process",
               1e3 * typical_s(few * _ROUNDS), "ms", at_most=2.2),
        Figure(f"{len(many)} distances in one request, in process", rate, "M points/s",
               at_least=1.5),
    ]  # fmt: skip


def _planner_points(made: DrivenStreet, count: int) -> list[Doubles]:
    """Return what each planner asks: ``count`` points around one place of the drive."""
    rng = np.random.default_rng(0)
    poses = made.drive.poses[np.arange(_CLIENTS) * len(made.drive.poses) // _CLIENTS]
    return [around(pose[:3, 3], count, rng) for pose in poses]


def _trained_per_s(server: Served, made: DrivenStreet, title: str) -> float:
    """Stream all scans; return how many samples were trained each second meanwhile."""
    before = server.client.status().samples_trained
    started = time.monotonic()
    stream(server.client, made.scans, title)
    trained = server.client.status().samples_trained - before
    return trained / (time.monotonic() - started)


def _one(server: Served, made: DrivenStreet, points: Doubles) -> list[Figure]:
    stream(server.client, made.scans, "streaming alone at first")
    with server.planner(points, "distance") as probe:
        time.sleep(_WARM_S)
        stream(server.client, made.scans, "streaming beside one planner")
        met = probe.finish()
    name = f"{_ASKED} distances to {REACH_M:g} m with gradient while streaming"
    return latency_figures(name, met, median_ms=4, tail_ms=12)


def _sixteen(server: Served, made: DrivenStreet, points: Sequence[Doubles]) -> list[Figure]:
    alone = _trained_per_s(server, made, "streaming alone")
    figures = [Figure("samples trained while streaming alone", alone / 1e6, "M/s")]
    for question in ("gradient", "distance"):
        with ExitStack() as probes:
            asking = [probes.enter_context(server.planner(each, question)) for each in points]
            time.sleep(2 * _WARM_S)
            title = f"streaming beside {_CLIENTS} planners ({question})"
            trained = _trained_per_s(server, made, title)
            lost = server.client.flush(FLUSH_TIMEOUT_S).lost
            met = [probe.finish() for probe in asking]
        name = f"{_CLIENTS} clients, {question}"
        figures += _met_together(name, met)
        figures += [
            Figure(f"{name}: training keeps", trained / alone, "", at_least=0.5),
            Figure(f"{name}: scans lost of {len(made.scans)}", lost, "", at_most=0),
        ]
    return figures


def _met_together(name: str, met: Sequence[ProbeReport]) -> list[Figure]:
    return [
        Figure(f"{name}: queries of {_ASKED} points", sum(report.queries for report in met), ""),
        Figure(f"{name}: errors", sum(report.errors for report in met), "", at_most=0),
        Figure(f"{name}: median of the clients' medians",
               float(np.median([report.latency_p50_ms for report in met])), "ms"),
        Figure(f"{name}: 99 % of the worst client",
               max(report.latency_p99_ms for report in met), "ms", at_most=50),
    ]  # fmt: skip
