"""``triquad-bench`` of one scan more: what it changes where it does not look.

A street is learnt, and then a single scan of another part of it, from which the first is out of
sight. Ideally the first does not change at all, and those who follow the mesh or keep a copy of the
map are sent what that scan showed.
"""

from dataclasses import dataclass

import numpy as np
from triquad_format.records.arrays import Doubles, Floats
from triquad_server.epochs.epoch import Epoch
from triquad_server.mesh.mesher import TileIndex, tile_lattice
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.process.threads import Teams
from triquad_server.settings import MeshSettings

from triquad_tools.benchmarks.figures import Figure
from triquad_tools.benchmarks.map_copy import MapCopy
from triquad_tools.benchmarks.mesh import EVERYWHERE, make_tiles
from triquad_tools.benchmarks.street import (
    learn_again,
    learn_all,
    sdf_error_cm,
    settled_mapper,
)
from triquad_tools.evaluation.map_scores import DrivenStreet, driven_street
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive, drive
from triquad_tools.simulation.street import street

_STEP_M = 1.0
_SCANS = 50  # of the place that is learnt first
_BETWEEN = 85  # metres from its end to the scan
_COLUMNS = 700
_POINTS = 100_000
_VOXEL_M = 0.2  # points of the surface are so far apart
_MOVED_M = 0.01


def measure_far_scan(seed: int) -> list[Figure]:
    """How a place moves that was learnt, after one scan elsewhere, and once that is repaired."""
    scene = street(seed, (_SCANS + _BETWEEN) * _STEP_M)
    poses = drive(scene, _SCANS + _BETWEEN, _STEP_M)
    lidar = Lidar(columns=_COLUMNS)
    place = driven_street(SimulatedDrive(scene, lidar, poses[:_SCANS], seed=seed))
    elsewhere = driven_street(SimulatedDrive(scene, lidar, poses[-1:], seed=seed))
    (scan,) = elsewhere.scans
    alone = settled_mapper("one scan elsewhere, alone", [scan])
    mapper = settled_mapper("the place", place.scans)
    before = _Place.of(mapper.publish(), place)
    follower, copy = _Follower(mapper.publish()), MapCopy.of(mapper.publish())
    mapper.ingest(scan.points, scan.world_from_sensor)
    shown = follower.outdated_by(mapper.publish())
    learn_all(mapper)
    after = _Place.of(mapper.publish(), place)
    learn_again(mapper)
    after_all = mapper.publish()
    repaired = _Place.of(after_all, place)
    sent = follower.sent_of(after_all)
    in_sight = _near(sent, scan.world_from_sensor[:3, 3], lidar.range_max_m)
    alone_cm = sdf_error_cm(alone.publish(), elsewhere.probes)
    beside_cm = sdf_error_cm(after_all, elsewhere.probes)
    newer = MapCopy.of(after_all)
    fetched = newer.fetched_by(copy) / len(newer.parts)
    return [
        Figure("SDF error of a place, settled", before.error_cm, "cm"),
        Figure(f"the same after one more scan {_BETWEEN} m away", after.error_cm, "cm"),
        Figure("the same once what was forgotten is learnt again", repaired.error_cm, "cm"),
        Figure("moved by more than 1 cm, before that", 100 * before.moved(after), "%"),
        Figure("and then", 100 * before.moved(repaired), "%", at_most=2.0),
        Figure("SDF error where that scan looks", beside_cm, "cm"),
        Figure(
            "the same, times that of a map of this scan alone",
            beside_cm / alone_cm,
            "",
            at_most=1.1,
        ),
        Figure("tiles of the mesh with new evidence", len(shown), ""),
        Figure(
            "tiles sent, times those with new evidence or changed in sight of the scan",
            len(sent) / len(shown | in_sight),
            "",
            at_most=1.2,
        ),
        Figure("parts of a copy of the map, before", len(copy.parts), ""),
        Figure("and then", len(newer.parts), ""),
        Figure("those that are fetched again", 100 * fetched, "%", at_most=10),
    ]


class _Follower:
    """Somebody who has the mesh, and what they are sent."""

    def __init__(self, epoch: Epoch) -> None:
        self._tiles = TileCache(MeshSettings(), Teams().meshing)
        self._tiles.refresh(epoch)
        make_tiles(self._tiles)
        self._revision = self._tiles.revision

    def outdated_by(self, epoch: Epoch) -> set[TileIndex]:
        """Tiles that have to be made again in an epoch."""
        self._tiles.refresh(epoch)
        return set(self._tiles.delta(0, *EVERYWHERE, self._revision, {}).to_make)

    def sent_of(self, epoch: Epoch) -> set[TileIndex]:
        """Tiles that are others in an epoch."""
        self._tiles.refresh(epoch)
        make_tiles(self._tiles)
        return {t.index for t in self._tiles.delta(0, *EVERYWHERE, self._revision, {}).ready}


def _near(tiles: set[TileIndex], place: Doubles, reach_m: float) -> set[TileIndex]:
    """The tiles whose middles are within a reach."""
    side_m = tile_lattice(MeshSettings(), 0).tile_side_m
    return {
        tile for tile in tiles if np.linalg.norm((np.array(tile) + 0.5) * side_m - place) <= reach_m
    }


@dataclass(frozen=True)
class _Place:
    """A place as a map shows it."""

    error_cm: float
    sdf: Floats  # at points of its surface

    @classmethod
    def of(cls, epoch: Epoch, place: DrivenStreet) -> "_Place":
        return cls(sdf_error_cm(epoch, place.probes), epoch.query(_surface(place)).sdf)

    def moved(self, other: "_Place") -> float:
        """The share of the surface that is elsewhere."""
        return float((np.abs(self.sdf - other.sdf) > _MOVED_M).mean())


def _surface(place: DrivenStreet) -> Doubles:
    points = place.drive.true_hits(_VOXEL_M)
    chosen = np.random.default_rng(0).permutation(len(points))[:_POINTS]
    surface: Doubles = points[chosen]
    return surface
