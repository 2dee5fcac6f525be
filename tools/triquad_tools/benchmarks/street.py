"""The drive that everything in ``triquad-bench`` is measured on."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from triquad_tools.evaluation.map_scores import DrivenStreet, driven_street
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive, drive
from triquad_tools.simulation.street import street

SCANS = 100
RATE_HZ = 10.0
_LENGTH_M = 110.0  # so that the map has some 2 million parameters
_COLUMNS = 1024  # some 60,000 points a scan
_VISIBLE_VOXEL_M = 0.05


@dataclass(frozen=True)
class BenchStreet(DrivenStreet):
    """A drive of 10 s, and the truth about it."""

    visible: NDArray[np.float64]  # [M, 3] exact surface points that the lidar hit


def bench_street(seed: int) -> BenchStreet:
    """100 scans along the exact street ``seed``."""
    scene = street(seed, _LENGTH_M)
    poses = drive(scene, SCANS, _LENGTH_M / SCANS)
    driven = driven_street(SimulatedDrive(scene, Lidar(columns=_COLUMNS), poses, seed))
    visible = driven.drive.true_hits(_VISIBLE_VOXEL_M)
    low, high = scene.bounds  # to which meshes are cut
    visible = visible[((visible >= low) & (visible <= high)).all(axis=1)]
    return BenchStreet(driven.drive, driven.scans, driven.probes, visible)
