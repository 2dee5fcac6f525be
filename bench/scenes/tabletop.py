"""Random small things on a table, and a depth camera that looks at them from all sides."""

import math

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_tools.simulation.lidar import SimulatedDrive
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import Solid, box, cylinder, half_space, sphere

from bench.scenes.camera import DepthCamera, looking_at

_HALF_X_M, _HALF_Y_M = 0.6, 0.4  # of the table
_FLOOR_M = -0.75  # below its top
_PLACES = (4, 3)  # along x and y
_AROUND_M = 0.02  # of the bounds, beyond the table
_TOP_M = 0.35
_SCAN_PERIOD_S = 0.1
_LAP_S = 20.0


def tabletop(seed: int) -> Scene:
    """Return a table with its top at ``z = 0`` and things of 3 to 25 cm on it, about the origin.

    The same seed gives the same things.
    """
    rng = np.random.default_rng(seed)
    parts: list[Solid] = [
        half_space(_FLOOR_M),
        box((0.0, 0.0, -0.02), (_HALF_X_M, _HALF_Y_M, 0.02)),
    ]
    columns, rows = _PLACES
    for column in range(columns):
        for row in range(rows):
            x = (column + 0.5) / columns * 2.0 - 1.0
            y = (row + 0.5) / rows * 2.0 - 1.0
            shift = rng.uniform(-0.03, 0.03, 2)
            parts += _thing(rng, 0.9 * _HALF_X_M * x + shift[0], 0.9 * _HALF_Y_M * y + shift[1])
    top = (_HALF_X_M + _AROUND_M, _HALF_Y_M + _AROUND_M, _TOP_M)
    bottom = (-_HALF_X_M - _AROUND_M, -_HALF_Y_M - _AROUND_M, -0.05)
    return Scene(tuple(parts), np.array([bottom, top]))


def tabletop_by_camera(seed: int, scans: int) -> SimulatedDrive:
    """Return a depth camera that is led around the table ``seed``, 10 scans a second.

    It is 0.3 to 1 m from what it looks at.
    """
    lap = np.arange(scans) * (_SCAN_PERIOD_S / _LAP_S)
    angle = 2.0 * math.pi * lap
    wave = np.sin(2.0 * math.pi * 3.0 * lap)
    targets = np.column_stack([0.35 * np.cos(angle), 0.2 * np.sin(angle), np.full(scans, 0.05)])
    # Above the highest thing, steeper where it is near.
    away, above = 0.45 + 0.2 * wave, 0.47 + 0.1 * wave
    offsets = np.column_stack([away * np.cos(angle), away * np.sin(angle), above])
    poses: Doubles = looking_at(targets + offsets, targets)
    return SimulatedDrive(tabletop(seed), DepthCamera(), poses, seed=seed)


def _thing(rng: np.random.Generator, x: float, y: float) -> list[Solid]:
    """Return a box, a ball, a cup, a bottle or a stack; it reaches a little into the table."""
    size, yaw = rng.uniform(0.015, 0.05), rng.uniform(0.0, math.pi)
    choice = rng.integers(5)
    if choice == 0:
        half = (size, rng.uniform(0.015, 0.05), rng.uniform(0.015, 0.08))
        return [box((x, y, half[2] - 0.005), half, yaw, 0.2 * min(half))]
    if choice == 1:
        return [sphere((x, y, size - 0.003), size)]
    if choice == 2:
        return [
            cylinder((x, y, 0.045), 0.04, 0.05),
            box(
                (x + 0.05 * math.cos(yaw), y + 0.05 * math.sin(yaw), 0.05),
                (0.015, 0.005, 0.03),
                yaw,
            ),
        ]
    if choice == 3:
        height = rng.uniform(0.08, 0.1)
        return [
            cylinder((x, y, height - 0.01), 0.035, height),
            cylinder((x, y, 2.0 * height + 0.02), 0.013, 0.04),
        ]
    parts: list[Solid] = []
    for step in range(3):
        half = (0.05 - 0.012 * step, 0.04 - 0.01 * step, 0.016)
        parts.append(box((x, y, 0.01 + 0.03 * step), half, yaw + 0.3 * step))
    return parts
