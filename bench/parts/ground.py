"""The ground: how right it is below points over the street, and how soon."""

import time

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.records.status import Status
from triquad_map.questions.ground import ground
from triquad_map.view import MapView
from triquad_tools.simulation.scene import Scene

from bench.clients.served import Served, latency_figures
from bench.figures import Figure, seconds
from bench.street_scores import DrivenStreet

MAX_DROP_M = 2.0
_PLACES = 20_000
_ASKED = 1_000
_ROUNDS = 15
_PROBED_S = 8.0
_BESIDE_M = 8.0  # the sensor's way
_ABOVE_M = 0.6  # the road: half a metre over the pavement
_CLEAR_M = 0.2
_STEPS = 200


def measure_ground(made: DrivenStreet, view: MapView) -> list[Figure]:
    """Return figures of a map of the street, asked in this process."""
    points = ground_points(made)
    truth_m = _true_heights(made.drive.scene, points)
    answer = ground(view, points, MAX_DROP_M)
    stands = answer.status == Status.SURFACE
    slopes = made.drive.scene.gradient(np.column_stack([points[:, :2], truth_m]))
    tilt_deg = np.abs(answer.slope_deg - np.degrees(np.arccos(np.clip(slopes[:, 2], 0, 1))))
    error_cm = 100 * np.abs(answer.height_m - truth_m)
    asked_s = [seconds(lambda: ground(view, points[:_ASKED], MAX_DROP_M)) for _ in range(_ROUNDS)]
    return [
        Figure(f"ground below {len(points)} points: found", 100 * stands.mean(), "%"),
        Figure("ground: unknown", 100 * (answer.status == Status.UNKNOWN).mean(), "%"),
        Figure("ground: taken for a hole", 100 * (answer.status == Status.FREE).mean(), "%",
               at_most=0),
        Figure("ground: height error, median", np.median(error_cm[stands]), "cm", at_most=1),
        Figure("ground: height error, 95 %", np.quantile(error_cm[stands], 0.95), "cm", at_most=3),
        Figure("ground: height off by 10 cm", 100 * (error_cm[stands] > 10).mean(), "%"),
        Figure("ground: slope error, median", np.median(tilt_deg[stands]), "deg"),
        Figure("ground: slope error, 95 %", np.quantile(tilt_deg[stands], 0.95), "deg"),
        Figure(f"ground below {_ASKED} points, in process", 1e3 * np.median(asked_s), "ms"),
    ]  # fmt: skip


def ground_latency(server: Served, points: Doubles) -> list[Figure]:
    """Return how soon a settled server answers another process."""
    with server.planner(points[:_ASKED], "ground") as probe:
        time.sleep(_PROBED_S)
        return latency_figures(f"ground below {_ASKED} points, through the network", probe.finish())


def ground_points(made: DrivenStreet) -> Doubles:
    """Return places [N, 3] in free space over walkable ground, next to the sensor's way."""
    rng = np.random.default_rng(0)
    way = made.drive.poses[rng.integers(len(made.drive.poses), size=_PLACES), :3, 3]
    points = way + rng.uniform(-_BESIDE_M, _BESIDE_M, way.shape)
    points[:, 2] = _ABOVE_M
    return np.asarray(points[made.drive.scene.sdf(points) > _CLEAR_M])


def _true_heights(scene: Scene, points: Doubles) -> Doubles:
    """Return the height [N] of the ground below, found by steps as long as the distance allows."""
    places = points.copy()
    for _ in range(_STEPS):
        places[:, 2] -= scene.sdf(places)
    return np.asarray(places[:, 2])
