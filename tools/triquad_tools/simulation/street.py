"""Random streets: houses, parked cars, poles and trees along a straight road."""

import math

import numpy as np

from triquad_tools.simulation.lidar import Lidar, Sensor, SimulatedDrive, drive
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import Solid, Vector, box, cylinder, gable, half_space, sphere

ROAD_HALF_WIDTH_M = 5.0
_PAVEMENT_M = 2.6  # width
_KERB_M = 0.14  # height of the pavement over the road
_BURIED_M = 1.0  # what stands on the ground reaches this far into it, so that no seam shows
_TOP_M = 13.0  # above all roofs
_MARGIN_M = 12.0  # of street before the start and after the end of the drive
_LIDAR = Lidar()


def street(seed: int, length_m: float = 100.0) -> Scene:
    """Return a street along x from ``x = 0`` to ``length_m``, its road surface at ``z = 0``.

    The same seed gives the same street. Bounds reach ``12`` m beyond both ends.
    """
    rng = np.random.default_rng(seed)
    parts: list[Solid] = [half_space(0.0)]
    houses: list[Solid] = []
    for side in (-1.0, 1.0):
        middle = (0.5 * length_m, side * (ROAD_HALF_WIDTH_M + 0.5 * _PAVEMENT_M), 0.0)
        half_x = 0.5 * length_m + _MARGIN_M
        parts.append(_standing(middle, half_x, 0.5 * _PAVEMENT_M, _KERB_M))
        of_side = _houses(rng, side, length_m)
        houses += of_side
        parts += of_side
        parts += _cars(rng, side, length_m)
        parts += _poles_and_trees(rng, side, length_m)
    bounds = np.array([[-_MARGIN_M, -24.0, -0.5], [length_m + _MARGIN_M, 24.0, _TOP_M]])
    return Scene(tuple(parts), bounds, drive_length_m=length_m, houses=tuple(houses))


def street_drive(
    seed: int, scans: int, step_m: float = 1.0, length_m: float = 100.0, sensor: Sensor = _LIDAR
) -> SimulatedDrive:
    """Return a drive along street ``seed``, scans ``step_m`` apart; always the same scans."""
    scene = street(seed, length_m)
    return SimulatedDrive(scene, sensor, drive(scene, scans, step_m), seed=seed)


def _standing(foot: Vector, half_x: float, half_y: float, height: float, yaw: float = 0.0) -> Solid:
    half_z = 0.5 * (height + _BURIED_M)
    centre = (foot[0], foot[1], foot[2] + height - half_z)
    return box(centre, (half_x, half_y, half_z), yaw)


def _houses(rng: np.random.Generator, side: float, length_m: float) -> list[Solid]:
    parts: list[Solid] = []
    x = -_MARGIN_M
    while x < length_m + _MARGIN_M - 6.0:
        half_x, half_y = rng.uniform(3.5, 7.0), rng.uniform(3.5, 5.0)
        front = ROAD_HALF_WIDTH_M + _PAVEMENT_M + rng.uniform(0.3, 3.0)
        foot = (x + half_x, side * (front + half_y), 0.0)
        make = _gabled_house if rng.uniform() < 0.5 else _flat_house
        parts += make(rng, foot, half_x, half_y)
        parts += _front(rng, side, foot, half_x, front)
        x += 2.0 * half_x + rng.uniform(0.6, 5.0)
    return parts


def _flat_house(
    rng: np.random.Generator, foot: Vector, half_x: float, half_y: float
) -> list[Solid]:
    """Return a block with a ledge around its top and a smaller block on its roof."""
    height = rng.uniform(5.0, 10.0)
    yaw = rng.normal(0.0, 0.015)
    ledge_z, over = height - rng.uniform(0.4, 0.8), rng.uniform(0.25, 0.5)
    wide = half_x + over, half_y + over
    attic = (foot[0] + rng.uniform(-1.0, 1.0), foot[1], height + 0.2)
    return [
        _standing(foot, half_x, half_y, height, yaw),
        box((foot[0], foot[1], ledge_z), (*wide, rng.uniform(0.12, 0.25)), yaw),
        box(attic, (0.45 * half_x, 0.5 * half_y, rng.uniform(1.0, 1.6)), yaw),
    ]


def _gabled_house(
    rng: np.random.Generator, foot: Vector, half_x: float, half_y: float
) -> list[Solid]:
    """Return a house with a pitched roof, its ridge along or across the street, and a chimney."""
    eave, rise = rng.uniform(3.5, 6.5), rng.uniform(1.8, 3.5)
    along = rng.uniform() < 0.6
    yaw = rng.normal(0.0, 0.015) + (0.0 if along else 0.5 * math.pi)
    half = (half_x, half_y) if along else (half_y, half_x)
    half_z = 0.5 * (eave + rise + _BURIED_M)
    centre = (foot[0], foot[1], foot[2] + eave + rise - half_z)
    shift = rng.uniform(0.2, 0.5)
    chimney = (
        foot[0] + shift * half_x * (1.0 if along else 0.4),
        foot[1] + shift * half_y * (0.4 if along else 1.0),
        eave + rise - 0.3,
    )
    return [
        gable(centre, (*half, half_z), eave + _BURIED_M, yaw),
        box(chimney, (0.3, 0.35, rng.uniform(1.0, 1.3)), yaw),
    ]


def _front(
    rng: np.random.Generator, side: float, foot: Vector, half_x: float, front: float
) -> list[Solid]:
    """Return the front of a house: a doorstep and perhaps a bay window or a balcony."""
    door = foot[0] + rng.uniform(-0.7, 0.7) * half_x
    step = _standing((door, side * front, 0.0), 0.8, 0.55, rng.uniform(0.3, 0.5))
    x = foot[0] + rng.uniform(-0.5, 0.5) * half_x
    choice = rng.integers(3)
    if choice == 0:
        bay = (x, side * (front + 0.3), 0.0)
        half_width, height = rng.uniform(0.9, 1.6), rng.uniform(2.6, 3.2)
        return [step, _standing(bay, half_width, 1.0, height)]
    if choice == 1:
        floor = (x, side * (front + 0.1), rng.uniform(2.6, 3.1))
        return [step, box(floor, (rng.uniform(1.0, 1.8), 1.1, 0.11))]
    return [step]


def _cars(rng: np.random.Generator, side: float, length_m: float) -> list[Solid]:
    parts: list[Solid] = []
    x = rng.uniform(-8.0, 2.0)
    while x < length_m + 6.0:
        if rng.uniform() < 0.6:
            parts += _car(rng, x, side * (ROAD_HALF_WIDTH_M - 1.1 + rng.uniform(-0.1, 0.1)))
        x += rng.uniform(6.0, 11.0)
    return parts


def _car(rng: np.random.Generator, x: float, y: float) -> list[Solid]:
    """Return a body, a cabin and four wheels on the road."""
    half_x, half_y = rng.uniform(1.9, 2.3), rng.uniform(0.83, 0.92)
    yaw = rng.normal(0.0, 0.03) + (math.pi if rng.uniform() < 0.5 else 0.0)
    van = rng.uniform() < 0.25
    body_z, body_half = 0.56, 0.36
    top = rng.uniform(1.75, 2.1) if van else rng.uniform(1.38, 1.55)
    cabin_half, cabin_x = (0.85 * half_x, -0.1 * half_x) if van else (0.5 * half_x, -0.12 * half_x)
    cos, sin = math.cos(yaw), math.sin(yaw)

    def at(along: float, across: float, z: float) -> Vector:
        return (x + cos * along - sin * across, y + sin * along + cos * across, z)

    cabin_half_z = 0.5 * (top - 0.5)
    cabin = cabin_half, half_y - 0.1, cabin_half_z
    parts = [
        box(at(0.0, 0.0, body_z), (half_x, half_y, body_half), yaw, 0.12),
        box(at(cabin_x, 0.0, top - cabin_half_z), cabin, yaw, 0.22),
    ]
    for along in (-0.62 * half_x, 0.62 * half_x):
        for across in (0.12 - half_y, half_y - 0.12):
            parts.append(box(at(along, across, 0.3), (0.31, 0.11, 0.31), yaw, 0.1))
    return parts


def _poles_and_trees(rng: np.random.Generator, side: float, length_m: float) -> list[Solid]:
    parts: list[Solid] = []
    x = rng.uniform(-8.0, 0.0)
    while x < length_m + 8.0:
        y = side * (ROAD_HALF_WIDTH_M + rng.uniform(0.4, 0.8))
        parts += _pole(rng, x, y, side) if rng.uniform() < 0.5 else _tree(rng, x, y)
        x += rng.uniform(7.0, 13.0)
    return parts


def _pole(rng: np.random.Generator, x: float, y: float, side: float) -> list[Solid]:
    """Return a lamp post with its arm, or a short sign post with its plate."""
    radius = rng.uniform(0.05, 0.15)
    lamp = rng.uniform() < 0.6
    height = rng.uniform(5.0, 7.0) if lamp else rng.uniform(2.3, 2.9)
    half_z = 0.5 * (height + _BURIED_M)
    post = cylinder((x, y, height - half_z), radius, half_z)
    if lamp:
        arm = (x, y - side * 0.7, height - 0.12)
        return [post, box(arm, (0.12, 0.8, 0.07), 0.0, 0.06)]
    plate = (x, y, height - 0.45)
    return [post, box(plate, (radius + 0.03, 0.33, 0.33), 0.0, 0.02)]


def _tree(rng: np.random.Generator, x: float, y: float) -> list[Solid]:
    """Return a trunk and a crown of balls."""
    trunk, crown = rng.uniform(2.2, 3.2), rng.uniform(1.0, 1.6)
    half_z = 0.5 * (trunk + 0.6 * crown + _BURIED_M)
    top = trunk + 0.8 * crown
    parts = [
        cylinder((x, y, trunk + 0.6 * crown - half_z), rng.uniform(0.12, 0.28), half_z),
        sphere((x, y, top), crown),
    ]
    for angle in rng.uniform(0.0, 2.0 * math.pi) + np.arange(4) * 0.5 * math.pi:
        out, up = 0.75 * crown, rng.uniform(-0.3, 0.6) * crown
        centre = (x + out * math.cos(angle), y + out * math.sin(angle), top + up)
        parts.append(sphere(centre, rng.uniform(0.5, 0.75) * crown))
    return parts
