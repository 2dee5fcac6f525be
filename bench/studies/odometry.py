"""``python -m bench.studies.odometry [FOLDER ...]``: ways that are found by clouds alone.

How far they drift, and how good a map of a street is that is made with such poses. Folders are
recorded clouds with poses of a SLAM, which are taken as the truth. Nothing here is tuned on.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from triquad_client import OfflineMap
from triquad_format.records.arrays import Doubles
from triquad_tools.console.command import ToolError, print_line
from triquad_tools.console.report import Row, print_rows
from triquad_tools.recordings.folders.cloud_folder import read_cloud_folder
from triquad_tools.recordings.odometry import find_trajectory
from triquad_tools.sensors.sweep import PosedScan, Sweep
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive, drive
from triquad_tools.simulation.street import street

from bench.driven import Driven
from bench.figures import Figure
from bench.street import settled_mapper
from bench.street_scores import driven_street

_PERIOD_NS = 100_000_000
_LENGTH_M = 110.0
_STREETS = {
    "street, 64 beams, 1 m a scan": (31, Lidar(columns=1024, noise_m=0.02), 100, 1.0),
    "street, 16 beams, 0.5 m a scan": (32, Lidar(beams=16, columns=900, noise_m=0.02), 200, 0.5),
}


def _found(scans: Sequence[PosedScan]) -> tuple[Doubles, list[Figure]]:
    """Return the poses [N, 4, 4] that odometry finds, placed at the first, and figures of them."""
    sweeps = [Sweep(scan.points, "lidar", n * _PERIOD_NS) for n, scan in enumerate(scans)]
    began_s = time.process_time()
    trajectory = find_trajectory(sweeps, len(sweeps))
    each_s = (time.process_time() - began_s) / len(scans)
    true = np.array([scan.world_from_sensor for scan in scans])
    poses = true[0] @ trajectory.poses
    way_m = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum()
    off_m = np.linalg.norm(poses[:, :3, 3] - true[:, :3, 3], axis=1)
    return poses, [
        Figure("way", way_m, "m"),
        Figure("off at its end, of the way", 100 * off_m[-1] / way_m, "%"),
        Figure("off at most", 100 * off_m.max(), "cm"),
        Figure("a scan, processor", 1e3 * each_s, "ms"),
    ]


def _f_score(made: Driven, poses: Doubles) -> float:
    scans = [PosedScan(scan.points, pose) for scan, pose in zip(made.scans, poses, strict=True)]
    with OfflineMap(settled_mapper("the street", scans).publish().record()) as opened:
        return made.mesh_scores(opened.mesh()).f_score


def _of_street(seed: int, lidar: Lidar, scans: int, step_m: float) -> list[Figure]:
    scene = street(seed, _LENGTH_M)
    made = driven_street(SimulatedDrive(scene, lidar, drive(scene, scans, step_m), seed=1))
    poses, figures = _found(made.scans)
    return [
        *figures,
        Figure("F of its map", 100 * _f_score(made, poses), "%"),
        Figure("F with the true poses", 100 * _f_score(made, made.drive.poses), "%"),
    ]


def main(argv: Sequence[str] | None = None) -> int:
    """Measure streets and recorded folders, and print the figures."""
    parser = argparse.ArgumentParser(prog="odometry", description=__doc__)
    parser.add_argument("folders", nargs="*", type=Path, metavar="FOLDER")
    options = parser.parse_args(argv)
    for name, about in _STREETS.items():
        print_rows(name, [Row(one.name, one.shown) for one in _of_street(*about)])
    for folder in options.folders:
        recording = read_cloud_folder(folder)
        try:
            figures = _found(list(recording.read(range(len(recording)))))[1]
        except ToolError as error:
            print_line(f"{folder.name}: {error}")
            continue
        print_rows(folder.name, [Row(one.name, one.shown) for one in figures])
    return 0


if __name__ == "__main__":
    sys.exit(main())
