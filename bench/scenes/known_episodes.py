"""The episodes by which the model of belief is chosen, and those by which it is only scored.

Another seed is not another scene: places, speeds, sensors and drives of the two groups differ.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_tools.simulation.lidar import Lidar, Sensor, SimulatedDrive, SimulatedScan, drive
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import Solid, box, cylinder, half_space
from triquad_tools.simulation.street import ROAD_HALF_WIDTH_M, street, street_drive

from bench.scenes.episodes import Episode, Things, straight_lane, thin_things
from bench.scenes.room import room_by_lidar

_BUSY_SCANS = 60
_ROBOT_Z_M = 0.6
_SENSOR_Z_M = 1.8


def tuned_episodes(scans: int) -> list[Episode]:
    """Return the episodes to tune on; after the busy ones, ``scans`` scans of the empty place."""
    streets = [_busy_street(scans), _street_in_rain(scans), _crossing(scans)]
    parks = [_car_park(scans), _car_park_in_rain(scans)]
    return [*streets, *parks, _room_with_people(scans), _tunnel(scans)]


def held_episodes(scans: int) -> list[Episode]:
    """Return the episodes that are only scored, likewise."""
    return [_yard(scans), _corridor(scans), _avenue_in_rain(scans)]


def _car(x: float, y: float, yaw: float = 0.0, size: float = 1.0) -> list[Solid]:
    back = (x - 0.2 * math.cos(yaw), y - 0.2 * math.sin(yaw), 1.15 * size)
    return [
        box((x, y, 0.6 * size), (2.1 * size, 0.85 * size, 0.4 * size), yaw, 0.1),
        box(back, (1.1 * size, 0.75 * size, 0.35 * size), yaw, 0.15),
    ]


def _person(x: float, y: float) -> list[Solid]:
    return [cylinder((x, y, 0.9), 0.25, 0.85)]


def _busy_street(scans: int) -> Episode:
    """A street with posts, wires and a fence: a car drives by, one parks and leaves, two walk."""
    thin = tuple(thin_things(6.0, -2.5))
    scene = street(3)
    scene = Scene((*scene.solids, *thin), scene.bounds, scene.drive_length_m)
    poses = drive(scene, _BUSY_SCANS + scans, 0.15)
    lidar = Lidar(columns=1024, elevation_max_deg=15.0)

    def things(time_s: float) -> Things:
        found = {
            "driving car": _car(-10.0 + 9.0 * time_s, 1.6),
            "walking": [
                *_person(8.0, -ROAD_HALF_WIDTH_M + 1.4 * time_s),
                *_person(18.0 + 1.4 * time_s, ROAD_HALF_WIDTH_M - 1.6),
            ],
        }
        if time_s < 4.5:
            found["parked car"] = _car(13.0, 2.0)
        angle = 0.5 * math.pi * min(1.0, time_s / 3.0)
        hinge = (7.0 + 0.45 * math.cos(angle), -6.2 + 0.45 * math.sin(angle), 1.15)
        found["door"] = [box(hinge, (0.45, 0.02, 1.0), angle)]
        return found

    lane = straight_lane((0.0, 25.0), 1.6, _ROBOT_Z_M)
    standing = SimulatedDrive(scene, lidar, poses, 3)
    return Episode("street", standing, things, _BUSY_SCANS, lane, thin)


def _street_in_rain(scans: int) -> Episode:
    """Another street, empty, while it rains: a return of a hundred comes from a drop."""
    standing = street_drive(5, _BUSY_SCANS + scans, 0.4)
    lane = straight_lane((2.0, 25.0), -1.6, _ROBOT_Z_M)
    return Episode("street in rain", standing, lambda _: {}, _BUSY_SCANS, lane, rain=0.01)


def _room_with_people(scans: int) -> Episode:
    """A room in which a person walks, another stands for long, and a box is taken away."""
    standing = room_by_lidar(2, _BUSY_SCANS + scans)

    def things(time_s: float) -> Things:
        return {
            "walking": _person(-1.6 + 0.5 * time_s, 1.95),
            "standing": _person(1.4, -1.9),
            "moved box": [box((-1.5, -1.8, 0.25), (0.3, 0.2, 0.25), 0.3)],
        }

    lane = straight_lane((-1.5, 1.5), 1.1, _ROBOT_Z_M)
    return Episode("room", standing, things, _BUSY_SCANS, lane, preset="indoor")


def _along(scans: int, start: float, step: float, y: float, sway: float) -> Doubles:
    """Return poses [scans, 4, 4] of a straight drive along x that sways from side to side."""
    poses = np.tile(np.eye(4), (scans, 1, 1))
    along = np.arange(scans) * step
    poses[:, 0, 3], poses[:, 2, 3] = start + along, _SENSOR_Z_M
    poses[:, 1, 3] = y + sway * np.sin(0.6 * along)
    return poses


def _to_and_fro(scans: int, span: float, step: float, y: float) -> Doubles:
    """Return poses [scans, 4, 4] of a robot that drives up and down along x."""
    poses = _along(scans, 0.0, 0.0, y, 0.0)
    phase = np.arange(scans) * step / span
    poses[:, 0, 3] = span * (1 - np.abs(phase % 2 - 1)) - 0.5 * span
    return poses


@dataclass(frozen=True)
class NonRepeating:
    """A sensor whose rays leave in other directions each time, forward in a cone."""

    rays: int = 24_000
    half_deg: float = 35.0
    noise_m: float = 0.02

    def scan(
        self, scene: Scene, world_from_sensor: Doubles, rng: np.random.Generator
    ) -> SimulatedScan:
        """Return one scan of ``scene`` from a pose ``[4, 4]`` in its free space."""
        angle = math.radians(self.half_deg) * np.sqrt(rng.random(self.rays))
        around = rng.uniform(0, 2 * math.pi, self.rays)
        across = np.sin(angle)
        rays = np.stack([np.cos(angle), across * np.cos(around), across * np.sin(around)], axis=1)
        lidar = _LidarOfRays(noise_m=self.noise_m, directions=rays)
        return lidar.scan(scene, world_from_sensor, rng)


@dataclass(frozen=True)
class _LidarOfRays(Lidar):
    """A lidar whose rays leave in given directions."""

    directions: Doubles = field(kw_only=True)  # [N, 3] unit vectors, sensor frame


def _crossing(scans: int) -> Episode:
    """A crossing at which a robot waits with 16 beams, while a lorry and cyclists pass."""
    corners = [
        box((side_x * 18.0, side_y * 16.0, 4.0), (12.0, 10.0, 5.0), 0.02)
        for side_x in (-1, 1)
        for side_y in (-1, 1)
    ]
    posts = [cylinder((x, y, 1.5), 0.06, 2.5) for x in (-5.5, 5.5) for y in (-5.5, 5.5)]
    bounds = np.array([[-30.0, -30.0, -1.0], [30.0, 30.0, 10.0]])
    scene = Scene((half_space(0.0), *corners, *posts), bounds)
    lidar = Lidar(beams=16, columns=1800, elevation_min_deg=-15.0, noise_m=0.02)
    poses = _along(_BUSY_SCANS + scans, -9.0, 0.02, -1.5, 0.1)

    def things(time_s: float) -> Things:
        lorry = box((3.0, -25.0 + 7.0 * time_s, 1.9), (1.2, 4.0, 1.5), 0.0, 0.1)
        rider = cylinder((-2.0, 20.0 - 4.5 * time_s, 0.95), 0.3, 0.85)
        found: dict[str, list[Solid]] = {"lorry": [lorry], "cyclist": [rider]}
        if time_s < 5.0:
            found["waiting car"] = _car(2.0, -1.6, 0.0, 1.1)
        return found

    lane = straight_lane((-8.0, 8.0), -1.5, _ROBOT_Z_M)
    standing = SimulatedDrive(scene, lidar, poses, 11)
    return Episode("crossing", standing, things, _BUSY_SCANS, lane)


def _park() -> Scene:
    rails = [box((0.0, side * 11.0, 0.5), (25.0, 0.05, 0.25)) for side in (-1, 1)]
    lamps = [cylinder((x, 0.0, 2.5), 0.09, 3.5) for x in (-15.0, 0.0, 15.0)]
    others = [part for x in (-14.0, -5.5, 9.5) for part in _car(x, -8.0, 0.5 * math.pi, 0.95)]
    kiosk = box((20.0, 8.0, 1.3), (1.5, 1.2, 1.4), 0.3)
    bounds = np.array([[-26.0, -14.0, -1.0], [26.0, 14.0, 8.0]])
    return Scene((half_space(0.0), *rails, *lamps, *others, kiosk), bounds)


def _car_park(scans: int) -> Episode:
    """A car park with 128 beams: three cars stand all the time, and then all have left."""
    sensor = Lidar(beams=128, columns=512, elevation_min_deg=-30.0, noise_m=0.015)
    poses = _to_and_fro(_BUSY_SCANS + scans, 24.0, 0.6, 2.0)

    def things(_: float) -> Things:
        return {
            "parked across": [*_car(-9.5, -8.0, 0.5 * math.pi), *_car(5.0, -8.1, 0.53 * math.pi)],
            "parked along": _car(4.0, 5.5, 0.1, 0.9),
        }

    lane = straight_lane((-10.0, 10.0), 5.5, _ROBOT_Z_M)
    standing = SimulatedDrive(_park(), sensor, poses, 12)
    return Episode("car park", standing, things, _BUSY_SCANS, lane)


def _car_park_in_rain(scans: int) -> Episode:
    """The car park, empty, in rain, by a sensor whose pattern does not repeat."""
    sensor: Sensor = NonRepeating()
    poses = _to_and_fro(_BUSY_SCANS + scans, 20.0, 0.3, 3.0)
    standing = SimulatedDrive(_park(), sensor, poses, 13)
    lane = straight_lane((-8.0, 12.0), 3.0, _ROBOT_Z_M)
    return Episode("car park in rain", standing, lambda _: {}, _BUSY_SCANS, lane, rain=0.01)


def _tunnel(scans: int) -> Episode:
    """A tunnel with a handrail, in which a cart rolls and two people stand; 5 cm of noise."""
    walls = [box((30.0, side * 3.6, 1.5), (45.0, 0.6, 2.5)) for side in (-1, 1)]
    roof, end = box((30.0, 0.0, 4.3), (45.0, 4.0, 0.5)), box((55.0, 0.0, 1.5), (0.5, 4.0, 3.0))
    rail = box((30.0, 2.8, 1.0), (45.0, 0.025, 0.025))
    bounds = np.array([[-15.0, -4.5, -1.0], [56.0, 4.5, 5.0]])
    scene = Scene((half_space(0.0), *walls, roof, end, rail), bounds)
    sensor = Lidar(beams=64, columns=600, elevation_max_deg=25.0, noise_m=0.05)
    poses = _along(_BUSY_SCANS + scans, -8.0, 0.1, -0.8, 0.3)

    def things(time_s: float) -> Things:
        cart = box((4.0 + 2.5 * time_s, 0.9, 0.6), (0.8, 0.5, 0.5), 0.05)
        return {"cart": [cart], "standing": [*_person(9.0, 1.6), *_person(14.0, -2.0)]}

    lane = straight_lane((0.0, 20.0), 0.9, _ROBOT_Z_M)
    standing = SimulatedDrive(scene, sensor, poses, 14)
    return Episode("tunnel", standing, things, _BUSY_SCANS, lane, (rail,))


def _yard(scans: int) -> Episode:
    """A yard with racks and a mesh fence, 32 beams: a forklift turns, pallets and a van leave."""
    racks = [box((x, 9.0, 1.6), (1.2, 0.5, 1.6)) for x in np.arange(-12.0, 13.0, 4.0)]
    fence = tuple(cylinder((x, -9.0, 0.9), 0.012, 1.0) for x in np.arange(-14.0, 14.0, 0.15))
    hall = box((0.0, 13.0, 3.0), (20.0, 1.5, 3.5), 0.04)
    masts = [cylinder((x, -6.0, 3.0), 0.12, 3.5) for x in (-9.0, 7.0)]
    bounds = np.array([[-24.0, -14.0, -1.0], [24.0, 16.0, 8.0]])
    scene = Scene((half_space(0.0), hall, *racks, *fence, *masts), bounds)
    sensor = Lidar(beams=32, columns=1200, elevation_min_deg=-25.0, noise_m=0.03)
    poses = _to_and_fro(_BUSY_SCANS + scans, 22.0, 0.9, 0.5)

    def things(time_s: float) -> Things:
        yaw = 0.8 * time_s
        at = (4.0 * math.cos(yaw), 5.0 + 1.5 * math.sin(yaw))
        fork = [
            box((*at, 0.8), (0.9, 0.55, 0.6), yaw, 0.05),
            box((*at, 1.9), (0.4, 0.4, 0.3), yaw),
        ]
        pallets = [box((x, -3.5, 0.55), (0.6, 0.4, 0.5), 0.2) for x in (-5.0, 2.0, 9.0)]
        van = [box((-9.0, 4.5, 1.2), (2.6, 1.0, 0.9), 0.15, 0.1)]
        return {"forklift": fork, "pallets": pallets, "van": van}

    lane = straight_lane((-11.0, 11.0), -3.5, _ROBOT_Z_M)
    standing = SimulatedDrive(scene, sensor, poses, 21)
    return Episode("yard", standing, things, _BUSY_SCANS, lane, fence)


def _corridor(scans: int) -> Episode:
    """A corridor with pillars indoors, 16 wide beams: a person waits, a trolley is pushed."""
    walls = [box((0.0, side * 1.7, 1.3), (14.0, 0.2, 1.7)) for side in (-1, 1)]
    ends = [box((side * 13.0, 0.0, 1.3), (0.3, 2.0, 1.7)) for side in (-1, 1)]
    pillars = [box((x, 1.35, 1.3), (0.18, 0.18, 1.7)) for x in (-8.0, -2.0, 4.0, 10.0)]
    ceiling = box((0.0, 0.0, 3.1), (14.0, 2.0, 0.3))
    bounds = np.array([[-14.0, -2.0, -0.5], [14.0, 2.0, 3.0]])
    scene = Scene((half_space(0.0), *walls, *ends, *pillars, ceiling), bounds)
    sensor = Lidar(beams=16, columns=1024, elevation_min_deg=-35.0, elevation_max_deg=35.0)
    poses = _to_and_fro(_BUSY_SCANS + scans, 14.0, 0.08, -0.4)
    poses[:, 2, 3] = 1.1

    def things(time_s: float) -> Things:
        trolley = box((-6.0 + 1.2 * time_s, 0.7, 0.5), (0.4, 0.25, 0.4))
        return {"waiting": _person(3.0, -1.1), "trolley": [trolley]}

    lane = straight_lane((-6.0, 6.0), 0.6, _ROBOT_Z_M)
    standing = SimulatedDrive(scene, sensor, poses, 22)
    return Episode("corridor", standing, things, _BUSY_SCANS, lane, preset="indoor")


def _avenue_in_rain(scans: int) -> Episode:
    """Another street by 32 noisy beams, fast, while it rains and a car drives ahead."""
    scene = street(11)
    poses = drive(scene, _BUSY_SCANS + scans, 0.8)
    sensor = Lidar(beams=32, columns=900, elevation_min_deg=-22.0, noise_m=0.03)

    def things(time_s: float) -> Things:
        return {"car ahead": _car(9.0 + 8.0 * time_s, -1.4)}

    lane = straight_lane((4.0, 34.0), -1.6, _ROBOT_Z_M)
    standing = SimulatedDrive(scene, sensor, poses, 23)
    return Episode("avenue in rain", standing, things, _BUSY_SCANS, lane, rain=0.01)
