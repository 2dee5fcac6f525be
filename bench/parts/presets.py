"""Presets: the places and sensors that each is for, streamed at 10 Hz."""

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from triquad_client import Mesh
from triquad_tools.evaluation.metrics import ScoreSettings
from triquad_tools.recordings.publishing import FLUSH_TIMEOUT_S, wait_until_settled
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive
from triquad_tools.simulation.street import street_drive

from bench.clients.served import served, stream
from bench.driven import Driven, driven
from bench.figures import Figure
from bench.scenes.room import room_by_camera, room_by_lidar
from bench.scenes.tabletop import tabletop_by_camera

_SETTLE_LIMIT_S = 300.0
_SCANS = 200


@dataclass(frozen=True)
class Place:
    """The purpose of a preset: a place, a sensor, and how right its map should be."""

    name: str
    preset: str
    make: Callable[[int], SimulatedDrive]  # for a seed
    f_scores: Mapping[float, float | None]  # by distance, metres: what F should be there, %
    voxel_m: float  # between the points of the truth and of the mesh that are compared


_FAR = Lidar(beams=128, columns=1024, range_max_m=120.0, noise_m=0.02)
_SIXTEEN = Lidar(beams=16, columns=1800, elevation_min_deg=-15.0, elevation_max_deg=15.0)
_STREET = partial(street_drive, scans=100, step_m=1.1, length_m=110.0)
_ALL_BEAMS = partial(_STREET, sensor=Lidar(columns=1024))
_FEW_BEAMS = partial(_STREET, sensor=_SIXTEEN)
_FAR_BEAMS = partial(street_drive, scans=150, step_m=2.0, length_m=300.0, sensor=_FAR)  # 72 km/h
_FINE = {0.02: 90.0, 0.05: 99.0}

PLACES = (
    Place("room, depth camera", "indoor", partial(room_by_camera, scans=_SCANS), _FINE, 0.01),
    Place("room, 64 beams", "indoor", partial(room_by_lidar, scans=_SCANS), _FINE, 0.01),
    Place("street, 64 beams", "street", _ALL_BEAMS, {0.1: 98.0}, 0.05),
    Place("street, 16 beams", "street", _FEW_BEAMS, {0.1: 98.0}, 0.05),
    Place(
        "tabletop, depth camera",
        "tabletop",
        partial(tabletop_by_camera, scans=_SCANS),
        {0.005: None, 0.01: 98.0, 0.02: None},
        0.0025,
    ),
    Place("long street, 128 beams", "long-range", _FAR_BEAMS, {0.1: None, 0.2: 99.0}, 0.05),
)


def measure(options: argparse.Namespace) -> list[Figure]:
    """Return figures of all places, each with a server of its preset."""
    return [figure for place in PLACES for figure in _place_figures(place, options.seed)]


def _place_figures(place: Place, seed: int) -> list[Figure]:
    made = driven(place.make(seed), place.voxel_m, place.name)
    with served(arguments=("--preset", place.preset)) as server:
        client = server.client
        stream(client, made.scans, f"{place.name}: streaming at 10 Hz")
        report = client.flush(FLUSH_TIMEOUT_S)
        started = time.monotonic()
        status = wait_until_settled(client, _SETTLE_LIMIT_S)
        settled_s = time.monotonic() - started
        mesh = client.mesh(made.drive.scene.box)
    points = float(np.mean([len(scan.points) for scan in made.scans]))
    lost = report.lost + report.refused
    figures = [
        Figure("points of a scan", points, ""),
        Figure(f"scans lost of {len(made.scans)}", lost, "", at_most=0),
        *_f_figures(place, made, mesh),
        Figure("from the last scan until settled", settled_s, "s"),
        Figure("parameters", status.parameters / 1e6, "M"),
        Figure("resident memory of the server", status.memory_bytes / 1e6, "MB"),
    ]
    return [replace(figure, name=f"{place.name}: {figure.name}") for figure in figures]


def _f_figures(place: Place, made: Driven, mesh: Mesh) -> list[Figure]:
    figures = []
    for within_m, wanted in place.f_scores.items():
        settings = ScoreSettings(threshold_m=within_m, voxel_m=place.voxel_m)
        scores = made.mesh_scores(mesh, settings)
        name = f"F-score at {100 * within_m:g} cm"
        figures.append(Figure(name, 100 * scores.f_score, "%", at_least=wanted))
    return [
        *figures,
        Figure("accuracy, mean", 100 * scores.accuracy_m, "cm"),
        Figure("samples beyond 20 cm", 100 * scores.outlier_ratio, "%"),
    ]
