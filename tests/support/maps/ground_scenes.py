"""A place of steps, holes, edges and slopes, and what a robot's lidar sees as it walks there."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from triquad_tools.simulation.lidar import Lidar, SimulatedScan
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import Solid, box, gable, half_space

KERB_M = 0.12
STEP_M = 0.17  # up, and down
TREAD_M = 0.3
RAMP_DEG = 15.0
HOLE_M = 0.6  # deep, both
BELOW_EDGE_M = -3.0
TABLE_M = 0.6  # its top
TABLE_THICK_M = 0.1

_WALL_M = 4.0
_EYE_M = 1.2
_LIDAR = Lidar(columns=540, elevation_min_deg=-60.0, elevation_max_deg=10.0)


def _block(x: tuple[float, float], y: tuple[float, float], top_m: float) -> Solid:
    """A block that is thick enough to stand on whatever lies below."""
    low_m = -3.5
    middle = (sum(x) / 2, sum(y) / 2, (top_m + low_m) / 2)
    return box(middle, ((x[1] - x[0]) / 2, (y[1] - y[0]) / 2, (top_m - low_m) / 2))


def _stairs(north: bool) -> list[Solid]:
    """Five treads from the corridor: up to the north, down to the south."""
    treads = []
    for tread in range(5):
        near, far = 2.0 + TREAD_M * tread, 2.0 + TREAD_M * (tread + 1)
        if north:
            treads.append(_block((-6, -3), (near, 6), STEP_M * (tread + 1)))
        else:
            treads.append(_block((-6, -3), (1.0 - far, 1.0 - near), -STEP_M * (tread + 1)))
    return treads


def _scene() -> Scene:
    rise_m = 3.0 * math.tan(math.radians(RAMP_DEG))
    north = [
        _block((-20, -6), (1, 6), 0.0),
        _block((-20, -6), (2, 6), KERB_M),
        _block((-6, -3), (1, 2), 0.0),
        *_stairs(north=True),
        _block((-3, 2), (1, 8), 0.0),
        gable((-1, 5, (rise_m - 1) / 2), (2, 3, (rise_m + 1) / 2), 1.0),
        _block((2, 5), (1, 2.5), -HOLE_M),  # beside the way: its bottom is seen
        _block((2, 5), (2.5, 6), 0.0),
        _block((5, 20), (1, 6), 0.0),
    ]
    south = [
        _block((-20, -6), (-6, -1), 0.0),
        *_stairs(north=False),
        _block((-6, -3), (-6, -2.5), -5 * STEP_M),
        _block((-3, 2), (-6, -1), 0.0),
        _block((2, 5), (-4.4, -1), 0.0),
        _block((2, 3.2), (-5, -4.4), 0.0),
        _block((3.2, 3.8), (-5, -4.4), -HOLE_M),  # far from it: its bottom is not
        _block((3.8, 5), (-5, -4.4), 0.0),
        _block((2, 5), (-6, -5), 0.0),
        _block((5, 6), (-6, -1), 0.0),  # and from here on there is an edge
    ]
    walls = [
        _block((-21, 21), (8, 9), _WALL_M),
        _block((-21, 5), (-7, -6), _WALL_M),
        _block((5, 21), (-13, -12), _WALL_M),
        _block((-21, -20), (-13, 9), _WALL_M),
        _block((20, 21), (-13, 9), _WALL_M),
    ]
    corridor = _block((-20, 20), (-1, 1), 0.0)
    table = box((8.6, 2.8, TABLE_M - TABLE_THICK_M / 2), (0.6, 0.6, TABLE_THICK_M / 2))
    solids = (half_space(BELOW_EDGE_M), corridor, table, *north, *south, *walls)
    return Scene(solids, np.array([[-21.0, -13, -4], [21, 9, 5]]))


SCENE = _scene()


def walk() -> Iterator[SimulatedScan]:
    """Scans along the corridor, and up and down the stairs."""
    on_stairs = [(2.6, 2), (3.2, 4), (4.2, 5), (-1.45, -2), (-2.05, -4), (-3.2, -5), (-4.2, -5)]
    places = [(x, 0.0, 0.0) for x in np.linspace(-12, 12, 25)]
    places += [(-4.5, y, STEP_M * steps) for y, steps in on_stairs]
    rng = np.random.default_rng(0)
    for x, y, floor in places:
        yield _LIDAR.scan(SCENE, _pose(x, y, floor + _EYE_M), rng)


def _pose(x: float, y: float, z: float) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose
