"""A world with moving things: what a map forgets of it, and what it keeps.

On a simulated street things move among others that stand, some of them thin, and then are gone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from triquad_client import Mesh
from triquad_format.records.arrays import Bools, Doubles
from triquad_map.mesh.marching_cubes import centroids
from triquad_map.mesh.mesher import mesh_tile
from triquad_map.questions.segments import segments
from triquad_server.epochs.epoch import Epoch
from triquad_server.mesh.tile_cache import tile_lattice
from triquad_server.settings import MeshSettings, Settings
from triquad_tools.console.progress import progress
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import Solid

from bench.ended_voxels import (
    EndedVoxels,
    end_keys,
    surface_share,
    voxel_centres,
    voxel_keys,
)
from bench.figures import Figure, typical
from bench.parts.revisited import revisited_figures
from bench.recorded import check_recorded
from bench.scenes.traffic import (
    LANE_M,
    Traffic,
    TrafficScan,
    lies_on,
    street_traffic,
    thin_things,
)
from bench.street import StreamedMap

BUSY_SCANS = 60
LOOKS = (0, 10, 30, 100, 300)  # scans of the empty street
_LEFT_AT_MOST = {10: 2.0, 30: 0.5}  # per cent of the trail, after N of them
_KEPT = (100, 300)  # scans of it after which what stands is to be there
_AFTER = 30  # scans of it after which the rest is measured
_TRAIL_CLEAR_M = 0.35  # from anything static: no voxel of the trail touches it
_GHOST_CLEAR_M = 0.2
_AIR_M = 0.05
_THIN_X_M, _THIN_Y_M = 6.0, -2.5  # next to the lane
_ROBOT_M, _REACH_M = 0.4, 1.0
_ROBOT_Z_M = 0.6
_WAY_M = 25  # of the lane, in which the car drove


def measure_moving(seed: int, folder: Path | None) -> list[Figure]:
    """Return figures of street ``seed`` with things that move, and, if given, of a recorded folder.

    Raises:
        ToolError: the folder cannot be read.
    """
    check_recorded("moving", folder)
    thin = tuple(thin_things(_THIN_X_M, _THIN_Y_M))
    traffic = street_traffic(seed, BUSY_SCANS, BUSY_SCANS + LOOKS[-1]).among(thin)
    figures = _street_figures(follow(traffic, thin, LOOKS))
    return figures if folder is None else figures + revisited_figures(folder)


def _street_figures(followed: "Followed") -> list[Figure]:
    looks = followed.looks
    after, name = looks[_AFTER], f"after {_AFTER}"
    figures = [_left(empty, look) for empty, look in looks.items()]
    for empty in _KEPT:
        lost, thin = 100 * (1 - looks[empty].static_kept), 100 * (1 - looks[empty].thin_kept)
        figures.append(Figure(f"static voxels lost after {empty}", lost, "%", at_most=0.3))
        figures.append(Figure(f"voxels of thin things alone lost after {empty}", thin, "%"))
    return [
        *figures,
        Figure(f"mesh left in the trail {name}", after.ghost_m2, "m2", at_most=0.5),
        Figure(f"trail in the air for the field {name}", 100 * after.air_in_trail, "%"),
        Figure("lane blocked after 0", looks[0].lane_blocked_m, "m"),
        Figure(f"lane blocked {name}", after.lane_blocked_m, "m", at_most=0),
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
    thin: Doubles  # [L, 3] of those of them in which rays ended on thin things alone
    trail: Doubles  # [M, 3] of those in which rays ended on moving things alone, clear of it

    @property
    def trail_left(self) -> float:
        """The share of the trail that is taken to be surface."""
        return surface_share(self.epoch, self.trail)

    @property
    def static_kept(self) -> float:
        """The share of static voxels that are taken to be surface."""
        return surface_share(self.epoch, self.static)

    @property
    def thin_kept(self) -> float:
        """The share of the voxels of thin things alone that are taken to be surface."""
        return surface_share(self.epoch, self.thin)

    @property
    def air_in_trail(self) -> float:
        """The share of the trail that the field knows to be in the air."""
        return float((self.epoch.query(self.trail).sdf > _AIR_M).mean())

    @property
    def lane_blocked_m(self) -> int:
        """Metres of the lane that a robot cannot pass because of what it takes to be surface."""
        starts = np.array([(x, LANE_M, _ROBOT_Z_M) for x in range(_WAY_M)])
        return int(
            segments(self.epoch, starts, starts + (1.0, 0, 0), _ROBOT_M, _REACH_M).blocked.sum()
        )

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
            area_m2 += float(Mesh(vertices, tile.faces[ghosts]).to_trimesh().area)
        return area_m2

    def _ghosts(self, middles: Doubles) -> Bools:
        """Return which of the faces with these centres [F, 3] lie in the trail."""
        voxel_m = self.epoch.voxel_m
        inside = np.isin(voxel_keys(middles, voxel_m), voxel_keys(self.trail, voxel_m))
        return np.asarray(inside & (self.scene.sdf(middles) > _GHOST_CLEAR_M))


@dataclass(frozen=True)
class Followed:
    """The results of a map of a street on which things move."""

    looks: dict[int, Look]  # by the scans of the empty street until then
    ingest_s: list[float]  # [n] of each scan


def follow(traffic: Traffic, thin: tuple[Solid, ...], looks: Sequence[int]) -> Followed:
    """Map a street, and measure the map after some numbers of scans of the empty street.

    ``thin`` are those of the standing things whose voxels are counted separately.
    """
    streamed = StreamedMap(Settings())
    seen = _Seen(traffic.standing.scene, Scene(thin, traffic.standing.scene.bounds))
    found: dict[int, Look] = {}
    with progress("things that move", len(traffic)) as report:
        for number, scan in enumerate(traffic, start=1):
            seen.add(scan, streamed.settings)
            streamed.take_in(scan)
            empty = number - traffic.busy_scans
            if empty in looks:
                found[empty] = seen.look(streamed.mapper.publish())
            report(number, f"{number} of {len(traffic)} scans")
    return Followed(found, streamed.ingest_s)


class _Seen:
    """The voxels of a street in which rays ended so far, by what they ended on."""

    def __init__(self, scene: Scene, thin: Scene) -> None:
        """``scene`` is that of all that stands, ``thin`` of some of it."""
        self._scene, self._thin = scene, thin
        self._on_moving, self._on_thin, self._on_others = (EndedVoxels() for _ in range(3))

    def add(self, scan: TrafficScan, settings: Settings) -> None:
        keys, thin = end_keys(scan, settings), lies_on(self._thin, scan.true_hits)
        self._on_moving.add(keys[scan.moving])
        self._on_thin.add(keys[thin])
        self._on_others.add(keys[~scan.moving & ~thin])

    def look(self, epoch: Epoch) -> Look:
        """Return a map, and the truth so far."""
        moving, thin, others = self._on_moving, self._on_thin, self._on_others
        static = np.union1d(thin.keys(), others.keys())
        trail = voxel_centres(np.setdiff1d(moving.keys(), static), epoch.voxel_m)
        alone = np.setdiff1d(thin.keys(), np.union1d(moving.keys(), others.keys()))
        return Look(
            epoch,
            self._scene,
            static=voxel_centres(static, epoch.voxel_m),
            thin=voxel_centres(alone, epoch.voxel_m),
            trail=trail[self._scene.sdf(trail) > _TRAIL_CLEAR_M],
        )
