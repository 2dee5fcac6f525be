"""A street on which things move, which a map is to forget, and thin things that stand."""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from triquad_format.records.arrays import Bools, Doubles
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive, SimulatedScan, drive
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import Solid, box, cylinder
from triquad_tools.simulation.street import ROAD_HALF_WIDTH_M, street

_PERIOD_S = 0.1  # from scan to scan
_STEP_M = 0.15  # of the sensor from scan to scan
_ON_SURFACE_M = 1e-6
LANE_M = 1.6  # where cars drive, to the left of the middle of the road

Movers = Callable[[float], list[Solid]]
"""The things that move, at a time in seconds from the start; none after all have left."""


@dataclass(frozen=True)
class TrafficScan(SimulatedScan):
    """A scan, and which of its points lie on things that move."""

    moving: Bools  # [N]


@dataclass(frozen=True)
class Traffic:
    """A slow drive along a street on which things move."""

    standing: SimulatedDrive  # without them
    movers: Movers
    busy_scans: int  # how many at first; then all that moves has left

    def __len__(self) -> int:
        return len(self.standing)

    def __iter__(self) -> Iterator[TrafficScan]:
        return (self.scan(index) for index in range(len(self)))

    def scan(self, index: int) -> TrafficScan:
        """Return scan ``index`` of the drive, always the same."""
        standing = self.standing
        moving = tuple(self.movers(index * _PERIOD_S))
        scene = Scene((*standing.scene.solids, *moving), standing.scene.bounds)
        rng = np.random.default_rng([standing.seed, index])
        made = standing.sensor.scan(scene, standing.poses[index], rng)
        on_moving = np.zeros(len(made.points), np.bool_)
        if moving:
            on_moving = lies_on(Scene(moving, standing.scene.bounds), made.true_hits)
        return TrafficScan(**vars(made), moving=on_moving)

    def among(self, solids: Iterable[Solid]) -> "Traffic":
        """Return the same drive with more things that stand on the street."""
        scene = self.standing.scene
        scene = replace(scene, solids=(*scene.solids, *solids))
        return replace(self, standing=replace(self.standing, scene=scene))


def lies_on(scene: Scene, points: Doubles) -> Bools:
    """Return which [N] of exact points ``[N, 3]``, world frame, lie on a scene's surface."""
    return np.asarray(np.abs(scene.sdf(points)) < _ON_SURFACE_M)


def street_traffic(seed: int, busy_scans: int, scans: int, lidar: Lidar | None = None) -> Traffic:
    """Return street ``seed`` with a car driving by, two people, a parked car that leaves, a door.

    After ``busy_scans`` of the ``scans`` all of them have left, the door, too. A scan is taken
    every 0.1 s and 0.15 m; without a ``lidar``, of some 60,000 points.
    """
    scene = street(seed)
    rng = np.random.default_rng([seed, 7])
    lidar = lidar or Lidar(columns=1024, elevation_max_deg=15.0)
    standing = SimulatedDrive(scene, lidar, drive(scene, scans, _STEP_M), seed)
    end_s = busy_scans * _PERIOD_S
    speed_m_s = rng.uniform(6.0, 12.0)
    first_x, second_x = rng.uniform(5.0, 12.0), rng.uniform(14.0, 22.0)
    parked_x = rng.uniform(8.0, 18.0)
    hinge_x = rng.uniform(4.0, 10.0)

    def movers(time_s: float) -> list[Solid]:
        if time_s >= end_s:
            return []
        leaves_m = max(0.0, time_s - 0.6 * end_s) * 5.0
        walked_m = 1.4 * time_s
        angle = 0.5 * math.pi * min(1.0, time_s / (0.5 * end_s))
        return [
            *_car(-10.0 + speed_m_s * time_s, LANE_M),
            *_car(parked_x + leaves_m, LANE_M + (0.0 if leaves_m else 0.6)),
            cylinder((first_x, -ROAD_HALF_WIDTH_M + walked_m, 0.9), 0.25, 0.85),
            cylinder((second_x + walked_m, ROAD_HALF_WIDTH_M - 1.6, 0.9), 0.25, 0.85),
            _door(hinge_x, angle),
        ]

    return Traffic(standing, movers, busy_scans)


def thin_things(x: float, y: float, length_m: float = 12.0) -> list[Solid]:
    """Return posts of 2 cm, two wires of 4 cm and a fence of bars of 16 mm.

    They stand along x for ``length_m`` from ``x`` on, within 1.2 m of ``y``, metres.
    """
    solids = [cylinder((x + i, y, 0.5), 0.01, 0.7) for i in np.arange(0.0, length_m, 2.0)]
    middle = x + 0.5 * length_m
    solids.append(box((middle, y - 0.6, 1.4), (0.5 * length_m, 0.02, 0.02), 0.0, 0.02))
    solids.append(box((middle, y + 0.6, 2.6), (0.5 * length_m, 0.02, 0.02), 0.0, 0.02))
    bars = np.arange(0.0, length_m, 0.12)
    solids += [cylinder((x + i, y + 1.2, 0.5), 0.008, 0.6) for i in bars]
    return solids


def _car(x: float, y: float) -> list[Solid]:
    return [
        box((x, y, 0.6), (2.1, 0.85, 0.4), 0.0, 0.1),
        box((x - 0.2, y, 1.15), (1.1, 0.75, 0.35), 0.0, 0.15),
    ]


def _door(x: float, angle: float) -> Solid:
    """Return a door in the street's side, opened by ``angle``; it turns about its hinge."""
    half = 0.45
    y = -(ROAD_HALF_WIDTH_M + 1.2)
    centre = (x + half * math.cos(angle), y + half * math.sin(angle), 1.15)
    return box(centre, (half, 0.02, 1.0), angle)
