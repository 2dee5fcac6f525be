"""``python -m bench.studies.odometry [FOLDER ...]``: ways that are found by clouds alone.

How far they drift, with loops closed and without, and how good a map is that is made with such
poses. Folders are recorded clouds with poses of a SLAM, which are taken as the truth. Nothing here
is tuned on.
"""

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
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

from bench.driven import Driven, driven
from bench.figures import Figure
from bench.scenes.block import block_drive
from bench.street import settled_mapper

_PERIOD_NS = 100_000_000
_LENGTH_M = 110.0
_VOXEL_M = 0.05  # between the points of a scene that completion asks for
_SIDE_M = 60.0  # of a block; around it a drive of 254 m comes back to its first 10 m
_64, _32 = Lidar(columns=1024, noise_m=0.02), Lidar(beams=32, columns=720, noise_m=0.03)
_16 = Lidar(beams=16, columns=900, noise_m=0.02)
_STREETS = {
    "street, 64 beams, 1 m a scan": (31, _64, 100, 1.0),
    "street, 16 beams, 0.5 m a scan": (32, _16, 200, 0.5),
}
_BLOCKS = {
    "around a block, 64 beams, 1 m a scan": (33, _64, 254, 1.0),
    "around a block, 32 beams, 1 m a scan": (34, _32, 254, 1.0),
    "around a block, 16 beams, 0.5 m a scan": (35, _16, 508, 0.5),
}


def _drives() -> Iterator[tuple[str, SimulatedDrive]]:
    for name, (seed, lidar, scans, step_m) in _STREETS.items():
        scene = street(seed, _LENGTH_M)
        yield name, SimulatedDrive(scene, lidar, drive(scene, scans, step_m), seed=1)
    for name, (seed, lidar, scans, step_m) in _BLOCKS.items():
        yield name, block_drive(seed, _SIDE_M, scans, step_m, lidar)


def _found(scans: Sequence[PosedScan], *, loops: bool) -> tuple[Doubles, list[Figure]]:
    """Return the poses [N, 4, 4] that odometry finds, placed at the first, and figures of them."""
    sweeps = [Sweep(scan.points, "lidar", n * _PERIOD_NS) for n, scan in enumerate(scans)]
    began_s = time.process_time()
    trajectory = find_trajectory(sweeps, len(sweeps), close_loops=loops)
    each_s = (time.process_time() - began_s) / len(scans)
    true = np.array([scan.world_from_sensor for scan in scans])
    poses = true[0] @ trajectory.poses
    way_m = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum()
    off_m = np.linalg.norm(poses[:, :3, 3] - true[:, :3, 3], axis=1)
    which = "loops closed" if loops else "no loops closed"
    return poses, [
        Figure(f"{which}: off at its end, of the way", 100 * off_m[-1] / way_m, "%"),
        Figure(f"{which}: off in the mean", 100 * off_m.mean(), "cm"),
        Figure(f"{which}: off at most", 100 * off_m.max(), "cm"),
        Figure(f"{which}: a scan, processor", 1e3 * each_s, "ms"),
    ]


def _f_score(made: Driven, poses: Doubles) -> float:
    scans = [PosedScan(scan.points, pose) for scan, pose in zip(made.scans, poses, strict=True)]
    with OfflineMap(settled_mapper("the scene", scans).publish().record()) as opened:
        return 100 * made.mesh_scores(opened.mesh()).f_score


def _of_drive(simulated: SimulatedDrive) -> list[Figure]:
    made = driven(simulated, _VOXEL_M)
    adrift, figures = _found(made.scans, loops=False)
    poses, more = _found(made.scans, loops=True)
    return [
        *figures,
        *more,
        Figure("F of its map, no loops closed", _f_score(made, adrift), "%"),
        Figure("F of its map, loops closed", _f_score(made, poses), "%"),
        Figure("F with the true poses", _f_score(made, made.drive.poses), "%"),
    ]


def main(argv: Sequence[str] | None = None) -> int:
    """Measure streets and recorded folders, and print the figures."""
    parser = argparse.ArgumentParser(prog="odometry", description=__doc__)
    only = "of the simulated drives, those whose names have this"
    parser.add_argument("--only", default="", metavar="TEXT", help=only)
    parser.add_argument("folders", nargs="*", type=Path, metavar="FOLDER")
    options = parser.parse_args(argv)
    for name, simulated in _drives():
        if options.only not in name:
            continue
        print_rows(name, [Row(one.name, one.shown) for one in _of_drive(simulated)])
    for folder in options.folders:
        recording = read_cloud_folder(folder)
        try:
            figures = _found(list(recording.read(range(len(recording)))), loops=True)[1]
        except ToolError as error:
            print_line(f"{folder.name}: {error}")
            continue
        print_rows(folder.name, [Row(one.name, one.shown) for one in figures])
    return 0


if __name__ == "__main__":
    sys.exit(main())
