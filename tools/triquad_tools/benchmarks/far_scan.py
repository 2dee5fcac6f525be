"""``triquad-bench`` of one scan more: what it changes where it does not look.

A street is learnt, and then a single scan of another part of it, from which the first is out of
sight. Ideally the first does not change at all.
"""

from dataclasses import dataclass

import numpy as np
from triquad_format.records.arrays import Doubles, Floats
from triquad_server.epochs.epoch import Epoch
from triquad_server.mapping.mapper import Mapper

from triquad_tools.benchmarks.figures import Figure
from triquad_tools.benchmarks.street import settled_mapper
from triquad_tools.evaluation.map_scores import DrivenStreet, driven_street, score_street
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
    (scan,) = SimulatedDrive(scene, lidar, poses[-1:], seed=seed)
    mapper = settled_mapper("the place", place.scans)
    before = _Place.of(mapper.publish(), place)
    mapper.ingest(scan.points, scan.world_from_sensor)
    _settle(mapper)
    after = _Place.of(mapper.publish(), place)
    while not mapper.settled:
        _settle(mapper)
        mapper.publish()
    repaired = _Place.of(mapper.publish(), place)
    return [
        Figure("SDF error of a place, settled", before.error_cm, "cm"),
        Figure(f"the same after one more scan {_BETWEEN} m away", after.error_cm, "cm"),
        Figure("the same once what was forgotten is learnt again", repaired.error_cm, "cm"),
        Figure("moved by more than 1 cm, before that", 100 * before.moved(after), "%"),
        Figure("and then", 100 * before.moved(repaired), "%", at_most=2.0),
    ]


@dataclass(frozen=True)
class _Place:
    """A place as a map shows it."""

    error_cm: float
    sdf: Floats  # at points of its surface

    @classmethod
    def of(cls, epoch: Epoch, place: DrivenStreet) -> "_Place":
        error_m = score_street(epoch.query, place.probes).sdf_error_m
        return cls(100 * error_m, epoch.query(_surface(place)).sdf)

    def moved(self, other: "_Place") -> float:
        """The share of the surface that is elsewhere."""
        return float((np.abs(self.sdf - other.sdf) > _MOVED_M).mean())


def _surface(place: DrivenStreet) -> Doubles:
    points = place.drive.true_hits(_VOXEL_M)
    chosen = np.random.default_rng(0).permutation(len(points))[:_POINTS]
    surface: Doubles = points[chosen]
    return surface


def _settle(mapper: Mapper) -> None:
    while not mapper.settled:
        mapper.train()
