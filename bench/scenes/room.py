"""Random furnished rooms, and drives through them."""

import math

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import Solid, Vector, box, cylinder, half_space, sphere

from bench.scenes.camera import DepthCamera, looking_at

_WALL_M = 0.3  # thickness of walls and ceiling
_AROUND_M = 0.1  # of the bounds, beyond the inner faces of the walls
_FREE_M = 0.75  # furniture at the walls keeps within this distance of them
_SPACING_M = 0.25  # between two pieces of furniture

_SCAN_PERIOD_S = 0.1
_LAP_S = 20.0
_TURNS = 2.0  # of a camera about the vertical, in each lap


def room(seed: int) -> Scene:
    """Return a room about the origin, its floor at ``z = 0``; the same seed gives the same room.

    There is a table with chairs in the middle, and furniture along the walls.
    """
    rng = np.random.default_rng(seed)
    half_x, half_y, height = rng.uniform(2.7, 3.3), rng.uniform(2.2, 2.7), rng.uniform(2.4, 2.8)
    parts: list[Solid] = [half_space(0.0), *_shell(half_x, half_y, height)]
    parts += _table_and_chairs(rng)
    for side in (-1.0, 1.0):
        parts += _row(rng, side, half_x, half_y, turned=False)
        parts += _row(rng, side, half_y - _FREE_M - _SPACING_M, half_x, turned=True)
    top = (half_x + _AROUND_M, half_y + _AROUND_M, height + _AROUND_M)
    bottom = (-half_x - _AROUND_M, -half_y - _AROUND_M, -_AROUND_M)
    return Scene(tuple(parts), np.array([bottom, top]))


def room_by_camera(seed: int, scans: int) -> SimulatedDrive:
    """Return a drive of a depth camera around the table of room ``seed``, 10 scans a second."""
    scene = room(seed)
    lap = _laps(scans)
    eyes = _way(scene, lap, height_m=1.2)
    turn = 2.0 * math.pi * _TURNS * lap
    pitch = np.radians(-12.0 + 22.0 * np.sin(2.0 * math.pi * 5.0 * lap))
    ahead = np.column_stack([np.cos(turn), np.sin(turn), np.tan(pitch)])
    return SimulatedDrive(scene, DepthCamera(), looking_at(eyes, eyes + ahead), seed=seed)


def room_by_lidar(seed: int, scans: int) -> SimulatedDrive:
    """Return a drive of a lidar of 64 beams around the table of room ``seed``, 10 scans/s."""
    scene = room(seed)
    lap = _laps(scans)
    poses = np.tile(np.eye(4), (scans, 1, 1))
    poses[:, :3, 3] = _way(scene, lap, height_m=1.0)
    turn = 2.0 * math.pi * lap
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(turn)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(turn), -np.sin(turn)
    lidar = Lidar(columns=1024, elevation_min_deg=-30.0, elevation_max_deg=30.0, range_min_m=0.3)
    return SimulatedDrive(scene, lidar, poses, seed=seed)


def _laps(scans: int) -> Doubles:
    """Return laps [scans] that were made at each scan."""
    return np.arange(scans, dtype=np.float64) * (_SCAN_PERIOD_S / _LAP_S)


def _way(scene: Scene, lap: Doubles, height_m: float) -> Doubles:
    """Return positions [n, 3] on an ellipse between the table and the furniture at the walls."""
    half = 0.5 * (scene.bounds[1] - scene.bounds[0])[:2] - _AROUND_M - _FREE_M - 0.4
    angle = 2.0 * math.pi * lap
    rise = 0.15 * np.sin(2.0 * math.pi * 3.0 * lap)
    return np.column_stack([half[0] * np.cos(angle), half[1] * np.sin(angle), height_m + rise])


def _shell(half_x: float, half_y: float, height: float) -> list[Solid]:
    """Return four walls and a ceiling around the inside; what overlaps lies behind their faces."""
    half_wall = 0.5 * _WALL_M
    middle_z, half_z = 0.5 * height, 0.5 * height + _WALL_M
    walls = [
        box((side * (half_x + half_wall), 0.0, middle_z), (half_wall, half_y + _WALL_M, half_z))
        for side in (-1.0, 1.0)
    ]
    walls += [
        box((0.0, side * (half_y + half_wall), middle_z), (half_x + _WALL_M, half_wall, half_z))
        for side in (-1.0, 1.0)
    ]
    ceiling = (0.0, 0.0, height + half_wall)
    return [*walls, box(ceiling, (half_x + _WALL_M, half_y + _WALL_M, half_wall))]


class _Place:
    """The place of a piece of furniture: it is built about its own base, its back to -y."""

    def __init__(self, x: float, y: float, yaw: float) -> None:
        self._x, self._y, self._yaw = x, y, yaw

    def at(self, along: float, across: float, z: float) -> Vector:
        """Return a point of the piece in the room."""
        cos, sin = math.cos(self._yaw), math.sin(self._yaw)
        return (
            self._x + cos * along - sin * across,
            self._y + sin * along + cos * across,
            z,
        )

    def box(self, middle: Vector, half: Vector, radius: float = 0.0) -> Solid:
        """Return a box of the piece."""
        return box(self.at(*middle), half, self._yaw, radius)

    def post(self, along: float, across: float, radius: float, top: float) -> Solid:
        """Return an upright post from the floor, into which it reaches."""
        half = 0.5 * (top + 0.1)
        return cylinder(self.at(along, across, top - half), radius, half)


def _table_and_chairs(rng: np.random.Generator) -> list[Solid]:
    place = _Place(rng.uniform(-0.1, 0.1), rng.uniform(-0.1, 0.1), rng.normal(0.0, 0.1))
    half_x, half_y, top = rng.uniform(0.5, 0.65), rng.uniform(0.32, 0.4), rng.uniform(0.7, 0.78)
    parts = [place.box((0.0, 0.0, top - 0.02), (half_x, half_y, 0.02))]
    for x in (-half_x + 0.06, half_x - 0.06):
        for y in (-half_y + 0.06, half_y - 0.06):
            parts.append(place.post(x, y, 0.03, top - 0.02))
    for _ in range(int(rng.integers(2, 5))):
        x, y = rng.uniform(-0.8, 0.8) * half_x, rng.uniform(-0.7, 0.7) * half_y
        parts += _thing(rng, place.at(x, y, top))
    for side in (-1.0, 1.0):
        x = rng.uniform(-0.4, 0.4) * half_x
        middle = place.at(x, side * (half_y - 0.02), 0.0)
        yaw = rng.normal(0.0, 0.15) + (0.0 if side < 0.0 else math.pi)
        parts += _chair(_Place(middle[0], middle[1], yaw))
    return parts


def _chair(place: _Place) -> list[Solid]:
    """Return a seat, a back and four legs."""
    parts = [
        place.box((0.0, 0.0, 0.45), (0.2, 0.2, 0.02)),
        place.box((0.0, -0.2, 0.72), (0.2, 0.015, 0.2)),
    ]
    for x in (-0.17, 0.17):
        parts.append(place.post(x, -0.2, 0.018, 0.9))
        parts.append(place.post(x, 0.17, 0.018, 0.44))
    return parts


def _thing(rng: np.random.Generator, foot: Vector) -> list[Solid]:
    """Return a cup, a box or a ball that stands on something."""
    x, y, z = foot
    size = rng.uniform(0.04, 0.09)
    choice = rng.integers(3)
    if choice == 0:
        return [cylinder((x, y, z + size - 0.01), 0.6 * size, size)]
    if choice == 1:
        half = (size, rng.uniform(0.5, 1.5) * size, rng.uniform(0.5, 1.5) * size)
        return [box((x, y, z + half[2] - 0.01), half, rng.uniform(0.0, math.pi))]
    return [sphere((x, y, z + size - 0.005), size)]


def _row(
    rng: np.random.Generator, side: float, reach: float, wall: float, *, turned: bool
) -> list[Solid]:
    """Return furniture along a wall, up to ``reach`` from its middle on both sides."""
    yaw = (0.0 if side < 0.0 else math.pi) + (0.5 * math.pi if turned else 0.0)
    # A quarter turn takes the back of a piece, at -y, to +x.
    away = -side if turned else side
    parts: list[Solid] = []
    along = -reach + 0.1
    while True:
        half = rng.uniform(0.35, 0.8)
        if along + 2.0 * half > reach - 0.1:
            return parts
        middle = along + half
        x, y = (away * wall, middle) if turned else (middle, away * wall)
        make = (_shelf, _sofa, _cupboard, _lamp, _picture)[rng.integers(5)]
        parts += make(rng, _Place(x, y, yaw), half)
        along += 2.0 * half + rng.uniform(0.5, 1.5) * _SPACING_M


def _shelf(rng: np.random.Generator, place: _Place, half: float) -> list[Solid]:
    """Return boards between two sides and a back, with books on them."""
    depth, height = rng.uniform(0.28, 0.36), rng.uniform(1.4, 2.0)
    middle = 0.5 * depth
    parts = [place.box((0.0, 0.005, 0.5 * height), (half, 0.015, 0.5 * height + 0.01))]
    for x in (-half + 0.01, half - 0.01):
        parts.append(place.box((x, middle, 0.5 * height), (0.012, middle, 0.5 * height + 0.01)))
    for z in np.arange(0.1, height, 0.36):
        parts.append(place.box((0.0, middle, float(z)), (half, middle, 0.012)))
        x = -half + 0.08
        while x < half - 0.12:
            if rng.uniform() < 0.5:
                book = (
                    0.5 * rng.uniform(0.04, 0.1),
                    rng.uniform(0.08, 0.12),
                    rng.uniform(0.1, 0.13),
                )
                at = (x + book[0], 0.02 + book[1], float(z) + 0.005 + book[2])
                parts.append(place.box(at, book))
                x += 2.0 * book[0]
            x += rng.uniform(0.02, 0.12)
    return parts


def _sofa(rng: np.random.Generator, place: _Place, half: float) -> list[Solid]:
    """Return a seat, a back, two arms and a cushion, all of them rounded."""
    depth = rng.uniform(0.6, 0.7)
    middle = 0.5 * depth
    return [
        place.box((0.0, middle, 0.2), (half, middle, 0.22), 0.05),
        place.box((0.0, 0.1, 0.45), (half, 0.1, 0.4), 0.06),
        place.box((-half + 0.08, middle, 0.35), (0.08, middle, 0.26), 0.05),
        place.box((half - 0.08, middle, 0.35), (0.08, middle, 0.26), 0.05),
        place.box((rng.uniform(-0.4, 0.4) * half, 0.28, 0.55), (0.2, 0.08, 0.18), 0.07),
    ]


def _cupboard(rng: np.random.Generator, place: _Place, half: float) -> list[Solid]:
    """Return a body with two handles, and things on it."""
    depth, height = rng.uniform(0.4, 0.6), rng.uniform(0.7, 1.1)
    parts = [place.box((0.0, 0.5 * depth, 0.5 * height), (half, 0.5 * depth, 0.5 * height + 0.01))]
    for x in (-0.06, 0.06):
        parts.append(place.box((x, depth + 0.01, 0.7 * height), (0.012, 0.02, 0.08), 0.01))
    for _ in range(int(rng.integers(1, 4))):
        x, y = rng.uniform(-0.7, 0.7) * half, rng.uniform(0.3, 0.7) * depth
        parts += _thing(rng, place.at(x, y, height + 0.01))
    return parts


def _lamp(rng: np.random.Generator, place: _Place, half: float) -> list[Solid]:
    """Return a lamp on a thin post, and a plant in a pot next to it."""
    x, height = -0.4 * half, rng.uniform(1.4, 1.7)
    plant, size = (0.5 * half, 0.3), rng.uniform(0.13, 0.18)
    parts = [
        place.post(x, 0.3, 0.015, height),
        place.post(x, 0.3, 0.15, 0.03),
        cylinder(place.at(x, 0.3, height), rng.uniform(0.13, 0.2), 0.13),
        place.post(*plant, 0.14, 0.3),
        place.post(*plant, 0.02, 0.6),
    ]
    for angle in np.arange(4) * 0.5 * math.pi:
        out = (plant[0] + 0.1 * math.cos(angle), plant[1] + 0.1 * math.sin(angle))
        parts.append(sphere(place.at(*out, 0.6 + rng.uniform(0.0, 0.25)), size))
    return parts


def _picture(rng: np.random.Generator, place: _Place, half: float) -> list[Solid]:
    """Return a picture on the wall, or a screen."""
    size = (0.7 * half, rng.uniform(0.015, 0.03), rng.uniform(0.2, 0.4))
    return [place.box((0.0, size[1] - 0.005, rng.uniform(1.3, 1.6)), size)]
