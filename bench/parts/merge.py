"""One street by two robots from both ends, their maps merged; and by one robot with all scans.

Once the poses of both are in one frame, and once in two, of which is known about how they lie.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from triquad_client import open_map
from triquad_format.records.pose import upright_pose
from triquad_tools.evaluation.metrics import MeshScores
from triquad_tools.simulation.lidar import Lidar
from triquad_tools.simulation.street import street_drive

from bench.driven import Driven, driven, write_recording
from bench.figures import Figure

_LENGTH_M, _SCANS, _OVERLAP = 160.0, 160, 20  # scans beyond the middle that each robot has
_VOXEL_M = 0.05
_SETTINGS = ("--set", "training.samples_per_ray=12")  # of 48
_OTHER_FRAME = (40.0, -25.0, 1.0, 70.0)  # of one robot, in that of the other: metres, degrees
_GUESS = (41.0, -24.0, 1.3, 74.0)
_PROGRAM = "from triquad_tools.commands.{0} import main; raise SystemExit(main())"


def measure(options: argparse.Namespace) -> list[Figure]:
    """Return how good the merged map is, and that of one robot."""
    drive = street_drive(options.seed, _SCANS, _LENGTH_M / _SCANS, _LENGTH_M, Lidar(columns=1024))
    street = driven(drive, _VOXEL_M, "a street")
    half = _SCANS // 2
    with tempfile.TemporaryDirectory(prefix="triquad-bench-") as name:
        folder = Path(name)
        whole = _mapped(street, folder, "whole", range(_SCANS))
        west = _mapped(street, folder, "west", range(half + _OVERLAP))
        east = _mapped(street, folder, "east", range(_SCANS - 1, half - _OVERLAP - 1, -1))
        merged = folder / "merged.triquad"
        _run("pack", "--merge", west, east, merged)
        turned = _mapped(street, folder, "turned", range(half + _OVERLAP), _OTHER_FRAME)
        aligned = folder / "aligned.triquad"
        _run("pack", "--merge", turned, east, aligned, "--align", *map(str, _GUESS))
        one, two, three = (_scores(street, path) for path in (whole, merged, aligned))
        return [
            Figure("one robot: F", 100 * one.f_score, "%"),
            Figure("two, merged: less F", 100 * (one.f_score - two.f_score), "points", at_most=0.3),
            Figure("one robot: mean error", 100 * one.accuracy_m, "cm"),
            Figure("two, merged: of that", two.accuracy_m / one.accuracy_m, ""),
            Figure("aligned, merged: less F", 100 * (one.f_score - three.f_score), "points",
                   at_most=0.3),
            Figure("aligned, merged: of that error", three.accuracy_m / one.accuracy_m, ""),
            Figure("merged: bytes, of one robot's", merged.stat().st_size / whole.stat().st_size,
                   ""),
        ]  # fmt: skip


def _mapped(
    street: Driven,
    folder: Path,
    name: str,
    chosen: range,
    frame: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
) -> Path:
    """Map some scans of a drive, in this order and in a frame; return the file."""
    recording, output = folder / name, folder / f"{name}.triquad"
    poses = np.linalg.inv(upright_pose(*frame)) @ street.drive.poses[list(chosen)]
    write_recording(recording, [street.scans[scan] for scan in chosen], poses, name)
    _run("map_recording", *_SETTINGS, "--training", recording, output)
    return output


def _run(program: str, *words: str | Path) -> None:
    """Run one of the programs; it raises where that fails."""
    command = [sys.executable, "-c", _PROGRAM.format(program), *map(str, words)]
    subprocess.run(command, check=True)


def _scores(street: Driven, path: Path) -> MeshScores:
    with open_map(path) as opened:
        return street.mesh_scores(opened.mesh(street.drive.scene.box))
