"""``triquad-bench`` of a world that moves: what a map forgets of it, and what it keeps.

Things move along a street and then are gone. The map trains and publishes between scans, as a
server's does.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from triquad_client import Mesh
from triquad_format.records.arrays import Bools, Doubles, Longs
from triquad_format.records.status import Status
from triquad_server.epochs import Epoch
from triquad_server.intake.rays import usable_rays
from triquad_server.launch import warm_up
from triquad_server.mapping.mapper import Mapper
from triquad_server.mesh.marching_cubes import centroids
from triquad_server.mesh.mesher import mesh_tile, tile_lattice
from triquad_server.settings import MeshSettings, Settings

from triquad_tools.benchmarks.figures import Figure, seconds, typical
from triquad_tools.console.progress import progress
from triquad_tools.evaluation.metrics import mesh_area_m2
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.traffic import (
    Traffic,
    TrafficScan,
    lies_on,
    street_traffic,
    thin_things,
)

BUSY_SCANS = 60
LOOKS = (0, 10, 30, 100)  # scans of the empty street
_LEFT_AT_MOST = {10: 2.0, 30: 0.5}  # per cent of the trail, after so many of them
_STEPS = 14  # of training between two scans
_PUBLISHED = 5  # one scan in so many
_TRAIL_CLEAR_M = 0.35  # from anything static: no voxel of the trail touches it
_GHOST_CLEAR_M = 0.2
_AIR_M = 0.05
_THIN_X_M, _THIN_Y_M = 6.0, -2.5  # beside the lane
_KEY_SIDE = 1 << 20  # voxels along an axis that keys can tell apart


def measure_moving(seed: int) -> list[Figure]:
    """Figures of street ``seed`` with things that move, and of thin things that stand there."""
    warm_up(Settings(), "cpu")
    traffic = street_traffic(seed, BUSY_SCANS, BUSY_SCANS + LOOKS[-1])
    followed = follow(traffic, LOOKS)
    last, after_30 = followed.looks[100], followed.looks[30]
    air = 100 * after_30.air_in_trail
    return [
        *(_left(empty, look) for empty, look in followed.looks.items()),
        Figure("static voxels kept after 100", 100 * last.static_kept, "%", at_least=99.7),
        Figure("voxels of thin things kept after 100", 100 * thin_kept(traffic), "%"),
        Figure("mesh left in the trail after 30", after_30.ghost_m2, "m2", at_most=0.5),
        Figure("trail in the air for the field after 30", air, "%"),
        Figure("take in a scan, things moving", 1e3 * typical(followed.ingest_s), "ms"),
    ]


def _left(empty: int, look: "Look") -> Figure:
    name = f"trail left after {empty} scans of the empty street"
    return Figure(name, 100 * look.trail_left, "%", at_most=_LEFT_AT_MOST.get(empty))


@dataclass(frozen=True)
class Look:
    """A map, and the truth about the voxels in which rays ended until then."""

    epoch: Epoch
    scene: Scene  # of what is static
    static: Doubles  # [N, 3] centres of the voxels in which rays ended on that
    trail: Doubles  # [M, 3] of those in which rays ended on moving things alone, clear of it

    @property
    def trail_left(self) -> float:
        """The share of the trail that is taken for surface."""
        return _surface_share(self.epoch, self.trail)

    @property
    def static_kept(self) -> float:
        """The share of static voxels that are taken for surface."""
        return _surface_share(self.epoch, self.static)

    @property
    def air_in_trail(self) -> float:
        """The share of the trail where the field knows that it is in the air."""
        return float((self.epoch.query(self.trail).sdf > _AIR_M).mean())

    @property
    def ghost_m2(self) -> float:
        """The area of the mesh's faces inside the trail, away from what is static."""
        half_m = self.epoch.voxel_m / 2
        lattice = tile_lattice(MeshSettings(), 0)
        tiles = lattice.tiles_meeting(self.trail - half_m, self.trail + half_m)
        area_m2 = 0.0
        for x, y, z in tiles.tolist():
            tile = mesh_tile(self.epoch, (x, y, z), lattice)
            vertices = tile.vertices + tile.origin
            ghosts = self._ghosts(centroids(vertices, tile.faces))
            area_m2 += mesh_area_m2(Mesh(vertices, tile.faces[ghosts]))
        return area_m2

    def _ghosts(self, middles: Doubles) -> Bools:
        """Which of faces with such middles [F, 3] lie in the trail."""
        voxel_m = self.epoch.voxel_m
        inside = np.isin(_keys(middles, voxel_m), _keys(self.trail, voxel_m))
        return np.asarray(inside & (self.scene.sdf(middles) > _GHOST_CLEAR_M))


@dataclass(frozen=True)
class Followed:
    """What became of a map on a street on which things move."""

    looks: dict[int, Look]  # by the scans of the empty street until then
    ingest_s: list[float]  # [n] of each scan


def follow(traffic: Traffic, looks: Sequence[int]) -> Followed:
    """Map a street, and look at the map after some numbers of scans of the empty street."""
    settings = Settings()
    mapper = Mapper("bench", settings, "cpu")
    ended = _Ended(settings, lambda scan: scan.moving)
    scene = traffic.standing.scene
    followed = Followed({}, [])
    with progress("things that move", len(traffic)) as report:
        for number, scan in enumerate(traffic, start=1):
            ended.add(scan)
            ingest = partial(mapper.ingest, scan.points, scan.world_from_sensor)
            followed.ingest_s.append(seconds(ingest))
            for _ in range(_STEPS):
                mapper.train()
            if number % _PUBLISHED == 0:
                mapper.publish()
            empty = number - traffic.busy_scans
            if empty in looks:
                trail = ended.only_marked
                trail = trail[scene.sdf(trail) > _TRAIL_CLEAR_M]
                look = Look(mapper.publish(), scene, static=ended.others, trail=trail)
                followed.looks[empty] = look
            report(number, f"{number} of {len(traffic)} scans")
    return followed


def thin_kept(traffic: Traffic) -> float:
    """The share of the voxels of thin things alone that a map has in the end; nothing is trained.

    They stand on the same street, with the same things moving.
    """
    settings = Settings()
    mapper = Mapper("bench", settings, "cpu")
    things = tuple(thin_things(_THIN_X_M, _THIN_Y_M))
    scene = Scene(things, traffic.standing.scene.bounds)
    ended = _Ended(settings, lambda scan: lies_on(scene, scan.true_hits))
    with progress("thin things", len(traffic)) as report:
        for number, scan in enumerate(traffic.among(things), start=1):
            ended.add(scan)
            mapper.ingest(scan.points, scan.world_from_sensor)
            report(number, f"{number} of {len(traffic)} scans")
    return _surface_share(mapper.publish(), ended.only_marked)


@dataclass
class _Ended:
    """Voxels in which rays ended so far, on things that are marked and on others."""

    settings: Settings
    mark: Callable[[TrafficScan], Bools]  # which points [N] lie on things to be marked
    _marked: Longs = field(default_factory=lambda: np.zeros(0, np.int64))
    _others: Longs = field(default_factory=lambda: np.zeros(0, np.int64))

    @property
    def only_marked(self) -> Doubles:
        """Centres [N, 3] of the voxels in which rays ended on marked things alone."""
        return _centres(np.setdiff1d(self._marked, self._others), self.settings.field.leaf_m)

    @property
    def others(self) -> Doubles:
        """Centres [N, 3] of the voxels in which rays ended on anything else."""
        return _centres(self._others, self.settings.field.leaf_m)

    def add(self, scan: TrafficScan) -> None:
        """Enter the voxels in which rays end that the map uses."""
        pose, leaf_m = scan.world_from_sensor, self.settings.field.leaf_m
        points = scan.points.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        ends = usable_rays(scan.points, pose, self.settings.scan).ends
        keys, marked = _keys(points, leaf_m), self.mark(scan)
        used = np.isin(keys, _keys(ends, leaf_m))
        self._marked = np.union1d(self._marked, keys[used & marked])
        self._others = np.union1d(self._others, keys[used & ~marked])


def _surface_share(epoch: Epoch, centres: Doubles) -> float:
    """The share of voxels in which rays are taken to have ended."""
    return float((epoch.status(centres, reach_m=0.0) == Status.SURFACE).mean())


def _keys(points: Doubles, voxel_m: float) -> Longs:
    """One number [N] for the voxel of each point [N, 3]."""
    cells = np.floor(points / voxel_m).astype(np.int64) + _KEY_SIDE // 2
    return np.asarray(cells @ np.array([_KEY_SIDE**2, _KEY_SIDE, 1]))


def _centres(keys: Longs, voxel_m: float) -> Doubles:
    """The middles [N, 3] of voxels."""
    cells = np.stack([keys // _KEY_SIDE**2, keys // _KEY_SIDE % _KEY_SIDE, keys % _KEY_SIDE], 1)
    return np.asarray((cells - _KEY_SIDE // 2 + 0.5) * voxel_m)
