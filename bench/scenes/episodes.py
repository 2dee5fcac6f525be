"""Places where things come and go, and from then on are watched again: what a map should forget.

An episode begins with scans amid things that move, and goes on with scans of the place without
them. Those to tune on and those that are only scored differ in place, sensor, drive and things.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from triquad_format.records.arrays import Doubles, Longs
from triquad_tools.simulation.lidar import SimulatedDrive, SimulatedScan
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import Solid, box, cylinder

PERIOD_S = 0.1  # from scan to scan
_ON_SURFACE_M = 1e-6
STANDING = -1
"""The number of what stands, in :attr:`EpisodeScan.thing_of`."""

Things = Mapping[str, list[Solid]]
"""The things that are there at a moment, by name."""


@dataclass(frozen=True)
class EpisodeScan(SimulatedScan):
    """A scan, and which thing each of its points lies on."""

    thing_of: Longs  # [N] number of the thing's name, or STANDING


@dataclass(frozen=True)
class Episode:
    """A drive past things that come and go."""

    name: str
    standing: SimulatedDrive  # the place without them
    things: Callable[[float], Things]  # at a time in seconds from the start
    busy_scans: int  # as many at first; then all things have left
    lane: Doubles  # [L, 2, 3] ways that are free once they have left, metres
    thin: tuple[Solid, ...] = ()  # standing things thinner than a voxel
    preset: str = "street"  # of the settings of its map
    rain: float = 0.0  # share of the returns of the busy scans that come from drops in mid air

    @property
    def names(self) -> list[str]:
        """The names of all things, by number; drops of rain come last."""
        times = np.arange(self.busy_scans) * PERIOD_S
        found = dict.fromkeys(name for time_s in times for name in self.things(float(time_s)))
        return [*found, "rain"] if self.rain else [*found]

    def __len__(self) -> int:
        return len(self.standing)

    def __iter__(self) -> Iterator[EpisodeScan]:
        names = self.names
        return (self._scan(index, names) for index in range(len(self)))

    def _scan(self, index: int, names: list[str]) -> EpisodeScan:
        drive, bounds = self.standing, self.standing.scene.bounds
        busy = index < self.busy_scans
        things = self.things(index * PERIOD_S) if busy else {}
        solids = [solid for parts in things.values() for solid in parts]
        rng = np.random.default_rng([drive.seed, index])
        scene = Scene((*drive.scene.solids, *solids), bounds)
        made = drive.sensor.scan(scene, drive.poses[index], rng)
        thing_of = np.full(len(made.points), STANDING)
        for name, parts in things.items():
            thing_of[lies_on(Scene(tuple(parts), bounds), made.true_hits)] = names.index(name)
        scan = EpisodeScan(**vars(made), thing_of=thing_of)
        return _rained_on(scan, self.rain, names, rng) if busy and self.rain else scan


def lies_on(scene: Scene, points: Doubles) -> np.ndarray:
    """Return which [N] of exact ``points`` [N, 3] lie on a scene's surface."""
    return np.abs(scene.sdf(points)) < _ON_SURFACE_M


def _rained_on(
    scan: EpisodeScan, share: float, names: list[str], rng: np.random.Generator
) -> EpisodeScan:
    """Return a scan with some of its returns from drops, at random ranges on their rays."""
    hit = rng.random(len(scan.points)) < share
    at = rng.uniform(0.03, 0.97, len(scan.points))
    shares = np.where(hit, at, 1.0)[:, None]
    origin = scan.world_from_sensor[:3, 3]
    return EpisodeScan(
        points=(shares * scan.points).astype(np.float32),
        true_hits=origin + shares * (scan.true_hits - origin),
        world_from_sensor=scan.world_from_sensor,
        no_return=scan.no_return,
        thing_of=np.where(hit, names.index("rain"), scan.thing_of),
    )


def straight_lane(x: tuple[float, float], y: float, z: float) -> Doubles:
    """Return ways [L, 2, 3] of a metre each along x."""
    starts = np.array([(along, y, z) for along in np.arange(*x)])
    return np.stack([starts, starts + (1.0, 0.0, 0.0)], axis=1)


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
