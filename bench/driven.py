"""Simulated drives, their scans, and the surface that a map of them should have."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from triquad_client import Mesh
from triquad_format.records.arrays import Doubles
from triquad_tools.console.progress import progress
from triquad_tools.evaluation.metrics import MeshScores, ScoreSettings, score_mesh
from triquad_tools.recordings.cloud import merged
from triquad_tools.sensors.sweep import PosedScan
from triquad_tools.simulation.lidar import SimulatedDrive


@dataclass(frozen=True)
class Driven:
    """A simulated drive, its scans, and what they show."""

    drive: SimulatedDrive
    scans: list[PosedScan]
    visible: Doubles  # [M, 3] exact surface points that were hit within the scene's bounds

    def mesh_scores(self, mesh: Mesh, settings: ScoreSettings | None = None) -> MeshScores:
        """Return scores of a mesh within the scene's bounds."""
        return score_mesh(mesh, self.visible, settings or ScoreSettings(), self.drive.scene.sdf)


def write_recording(folder: Path, scans: Iterable[PosedScan], poses: Doubles, name: str) -> None:
    """Write scans into a new folder as KITTI's, one by one, with their poses [n, 4, 4]."""
    folder.mkdir()
    with progress(f"writing {name}", len(poses)) as report:
        for number, scan in enumerate(scans):
            rows = np.zeros((len(scan.points), 4), "<f4")
            rows[:, :3] = scan.points
            rows.tofile(folder / f"{number:06d}.bin")
            report(number, f"{number} scans")
    np.savetxt(folder / "poses.txt", poses[:, :3].reshape(-1, 12), fmt="%.9f")


def driven(drive: SimulatedDrive, voxel_m: float, name: str = "the drive") -> Driven:
    """Make all scans of a drive; visible is one point per voxel of side ``voxel_m``."""
    low, high = drive.scene.bounds  # to which meshes are cut
    scans: list[PosedScan] = []

    def hits() -> Iterator[Doubles]:
        with progress(f"simulating {name}", len(drive)) as report:
            for scan in drive:
                scans.append(PosedScan(scan.points, scan.world_from_sensor))
                report(len(scans), f"{len(scans)} of {len(drive)} scans")
                inside = (scan.true_hits >= low) & (scan.true_hits <= high)
                yield scan.true_hits[inside.all(axis=1)]

    visible = merged(hits(), voxel_m)
    return Driven(drive, scans, visible)
