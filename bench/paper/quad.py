"""A court like that of the Newer College Dataset: walls around a lawn, arcades, trees and paths."""

import math

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive, poses_along
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import Solid, box, cylinder, gable, half_space, sphere

_HALF_M = 22.0  # from the middle to the inner walls
_WALL_M = 9.0  # height
_DEEP_M = 3.0  # thickness of the buildings that are seen of them
_WALK_M = 13.0  # half side of the way
_SENSOR_HEIGHT_M = 1.5
_BURIED_M = 1.0


def quad(seed: int) -> Scene:
    """Return a court of 44 m around 0 0 0, its lawn at ``z = 0``; the same for the same seed."""
    rng = np.random.default_rng(seed)
    parts: list[Solid] = [half_space(0.0)]
    for side in range(4):
        parts += _wing(side)
    for _ in range(7):
        x, y = rng.uniform(-9.0, 9.0, 2)
        parts += _tree(float(x), float(y), rng)
    parts.append(box((0.0, 0.0, 0.0), (1.2, 1.2, 0.9)))  # the base of a monument
    parts.append(cylinder((0.0, 0.0, 2.0), 0.35, 1.2))
    edge = _HALF_M + _DEEP_M
    bounds = np.array([[-edge, -edge, -0.5], [edge, edge, _WALL_M + 5.0]])
    return Scene(tuple(parts), bounds)


def _wing(side: int) -> list[Solid]:
    """Return a building along one side, with buttresses, a plinth and a roof."""
    yaw = side * math.pi / 2
    cos, sin = math.cos(yaw), math.sin(yaw)

    def at(along: float, out: float, z: float) -> tuple[float, float, float]:
        return out * cos - along * sin, out * sin + along * cos, z

    middle = _HALF_M + _DEEP_M / 2
    half_z = (_WALL_M + _BURIED_M) / 2
    parts = [box(at(0.0, middle, half_z - _BURIED_M), (_DEEP_M / 2, middle + 2.0, half_z), yaw)]
    parts.append(box(at(0.0, _HALF_M - 0.15, 0.1), (0.15, _HALF_M, 0.5), yaw))  # a plinth
    roof = at(0.0, middle, _WALL_M + 1.0)
    parts.append(gable(roof, (_HALF_M + 3.0, _DEEP_M / 2 + 0.3, 1.2), 0.3, yaw + math.pi / 2))
    for along in np.arange(-18.0, 18.1, 4.5).tolist():
        parts.append(box(at(along, _HALF_M - 0.4, 2.5), (0.4, 0.3, 3.5), yaw))
    return parts


def _tree(x: float, y: float, rng: np.random.Generator) -> list[Solid]:
    height = float(rng.uniform(2.5, 4.5))
    crown = float(rng.uniform(1.0, 1.8))
    trunk = cylinder((x, y, height / 2 - _BURIED_M / 2), 0.18, (height + _BURIED_M) / 2)
    leaves = [sphere((x, y, height + 0.6 * crown), crown)]
    for angle in (0.0, 2.1, 4.2):
        aside = (x + 0.7 * crown * math.cos(angle), y + 0.7 * crown * math.sin(angle))
        leaves.append(sphere((*aside, height + 0.2 * crown), 0.6 * crown))
    return [trunk, *leaves]


def quad_walk(seed: int, scans: int, lidar: Lidar) -> SimulatedDrive:
    """Return a walk around the lawn with a lidar."""
    turns = np.linspace(0.0, 2.0 * math.pi, scans, endpoint=False)
    radius = _WALK_M * (1.0 + 0.08 * np.sin(4.0 * turns))
    height = np.full(scans, _SENSOR_HEIGHT_M)
    places: Doubles = np.column_stack([radius * np.cos(turns), radius * np.sin(turns), height])
    poses = poses_along(_WALK_M * turns, places, turns + math.pi / 2)
    return SimulatedDrive(quad(seed), lidar, poses, seed=seed)
