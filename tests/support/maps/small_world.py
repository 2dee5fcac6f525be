"""A short drive through the exact street, shared by the tests of the server's core."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from triquad_server.epochs.epoch import Epoch
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings
from triquad_tools.simulation.lidar import Lidar, SimulatedScan, drive
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import box, half_space
from triquad_tools.simulation.street import street

WALLED = (
    half_space(0.0),
    box((8.0, 0.0, 2.0), (0.2, 8.0, 2.0)),
    box((0.0, 7.0, 2.0), (8.0, 0.2, 2.0)),
    box((0.0, -7.0, 2.0), (8.0, 0.2, 2.0)),
)
"""An empty place between three walls, for things that come and go."""

WALLED_BOUNDS = (np.array([-9.0, -9, -1]), np.array([9.0, 9, 5]))


@dataclass(frozen=True)
class World:
    """A scene and what a lidar saw of it."""

    scene: Scene
    scans: tuple[SimulatedScan, ...]

    @property
    def hits(self) -> NDArray[np.float64]:
        """True hits [N, 3] of all scans."""
        return np.concatenate([scan.true_hits for scan in self.scans])


@cache
def world(scans: int = 6, step_m: float = 1.5) -> World:
    """A drive of a few scans."""
    scene = street(3)
    rng = np.random.default_rng(0)
    lidar = Lidar(columns=360)
    poses = drive(scene, scans, step_m)
    return World(scene, tuple(lidar.scan(scene, pose, rng) for pose in poses))


def settings(**training: object) -> Settings:
    """Small regions, so that a street has several."""
    return Settings.model_validate(
        {"field": {"depth": 8}, "training": {"batch": 4096, "samples_per_ray": 18.0, **training}}
    )


def take_in(mapper: Mapper, *scans: SimulatedScan) -> None:
    """Have a mapper take in scans."""
    for scan in scans:
        mapper.ingest(scan.points, scan.world_from_sensor)


def mapper_of(*scans: SimulatedScan, chosen: Settings | None = None, device: str = "cpu") -> Mapper:
    """A mapper that has taken in scans, with settings for small regions unless others are given."""
    mapper = Mapper("test", chosen or settings(), device)
    take_in(mapper, *scans)
    return mapper


def settled_mapper(chosen: Settings, drive_through: World, device: str = "cpu") -> Mapper:
    """A mapper that learnt all it can of a world."""
    mapper = mapper_of(*drive_through.scans, chosen=chosen, device=device)
    settle(mapper)
    return mapper


@cache
def settled(scans: int = 6) -> Mapper:
    """A mapper that learnt all it can of a short drive: all share it, and leave it as it is."""
    mapper = settled_mapper(settings(), world(scans))
    mapper.publish()
    return mapper


def settled_epoch(scans: int = 6) -> Epoch:
    """All that can be learnt of a drive of a few scans: an epoch never changes, so all share it."""
    return settled(scans).publish()


def settle(mapper: Mapper) -> None:
    """Train until nothing is left to learn."""
    while not mapper.settled:
        mapper.train()


def damage(mapper: Mapper) -> None:
    """Have the field forget, and be trained for a step: what was not is not judged."""
    for region in mapper.regions:
        if len(region.training.rays.pool) == 0:
            continue
        region.field.thaw()  # what was published stays as it is
        values = region.field.features.values
        values += 0.5 * values.std() * np.random.default_rng(0).standard_normal(values.shape)
        region.training.budget.samples = 1


def surface_error(
    epoch: Epoch,
    drive_through: World,
    count: int = 20_000,
    offset: NDArray[np.float64] | float = 0.0,
) -> float:
    """Mean |SDF error| in metres at points within 0.1 m of the seen surface.

    ``offset`` [3] is where the map has the world's origin.
    """
    rng = np.random.default_rng(9)
    hits = drive_through.hits
    hits = hits[rng.choice(len(hits), count)]
    normals = drive_through.scene.gradient(hits)
    points = hits + normals * rng.uniform(-0.1, 0.1, (count, 1))
    points = points[drive_through.scene.is_exact(points)]
    error = epoch.query(points + offset, gradient=False).sdf - drive_through.scene.sdf(points)
    return float(np.abs(error).mean())
