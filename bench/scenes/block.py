"""Four streets around a block of houses, and drives around it: a way that closes."""

import math
from dataclasses import replace

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive, poses_along
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import Solid, half_space
from triquad_tools.simulation.street import street

_CROSSING_M = 40.0  # of each side, at its ends, is free of what stands along its street
_CORNER_M = 6.0  # radius of the way around a corner
_HEIGHT_M = 1.8  # of the sensor above the road
_WEAVE_M = 0.3
_AROUND_M, _DEEP_M, _TOP_M = 24.0, 0.5, 13.0  # bounds beyond the streets, below and above the road


def block(seed: int, side_m: float) -> Scene:
    """Return a block about the origin, the middles of its streets ``side_m`` long squares' sides.

    The same seed gives the same block. Each street is another one of :func:`street`.
    """
    length_m = side_m - _CROSSING_M
    parts: list[Solid] = [half_space(0.0)]
    for side in range(4):
        along = street(4 * seed + side, length_m)
        parts += [_turned(part, side, length_m, side_m) for part in along.solids[1:]]
    far = 0.5 * side_m + _AROUND_M
    return Scene(tuple(parts), np.array([[-far, -far, -_DEEP_M], [far, far, _TOP_M]]))


def block_drive(
    seed: int, side_m: float, scans: int, step_m: float, lidar: Lidar
) -> SimulatedDrive:
    """Return a drive around block ``seed``, and on, scans ``step_m`` apart along its way."""
    travelled = np.arange(scans, dtype=np.float64) * step_m
    places, ahead = _way(travelled, side_m), _way(travelled + 0.05, side_m)
    yaw = np.arctan2(*(ahead - places)[:, 1::-1].T)
    weave = _WEAVE_M * np.sin(0.17 * travelled)
    places += np.column_stack([-np.sin(yaw) * weave, np.cos(yaw) * weave, 0.0 * weave])
    poses = poses_along(travelled, places, yaw)
    return SimulatedDrive(block(seed, side_m), lidar, poses, seed=seed)


def _turned(part: Solid, side: int, length_m: float, side_m: float) -> Solid:
    """Return a part of a street as it stands at one of the four sides."""
    x, y, z = part.centre
    x, y = x - 0.5 * length_m, y - 0.5 * side_m
    cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[side]
    centre = cos * x - sin * y, sin * x + cos * y, z
    return replace(part, centre=centre, yaw=part.yaw + 0.5 * math.pi * side)


def _way(travelled: Doubles, side_m: float) -> Doubles:
    """Return positions [N, 3] on a square with round corners, from the begin of its first side."""
    half, straight = 0.5 * side_m, side_m - 2 * _CORNER_M
    quarter = straight + 0.5 * math.pi * _CORNER_M
    side, along = np.divmod(travelled, quarter)
    angle = np.maximum(along - straight, 0.0) / _CORNER_M
    x = _CORNER_M - half + np.minimum(along, straight) + _CORNER_M * np.sin(angle)
    y = _CORNER_M - half - _CORNER_M * np.cos(angle)
    cos, sin = np.cos(0.5 * math.pi * side), np.sin(0.5 * math.pi * side)
    return np.column_stack([cos * x - sin * y, sin * x + cos * y, np.full(len(x), _HEIGHT_M)])
