"""``python -m bench.evaluate``: how good a mesh is, such as one of ``triquad-map``."""

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_tools.console.arguments import not_negative, positive
from triquad_tools.console.command import OK, ToolError, run
from triquad_tools.console.lines import print_line
from triquad_tools.console.report import Row, json_text, print_rows
from triquad_tools.recordings.cloud import merged, points_in_range
from triquad_tools.recordings.folders.cloud_folder import read_cloud_folder
from triquad_tools.sensors.sweep import PosedScan, moved

from bench.mesh_file import read_mesh
from bench.mesh_scores import MeshScores, ScoreSettings, score_mesh

_COMMAND = "bench.evaluate"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool: 0 done, 2 wrong usage or input that cannot be used."""
    return run(_COMMAND, partial(_evaluate, _parser().parse_args(argv)))


def _evaluate(options: argparse.Namespace) -> int:
    mesh = read_mesh(options.mesh)
    if not len(mesh.faces):
        raise ToolError(f"{options.mesh}: has no faces; a cloud can only be a --reference")
    settings = ScoreSettings(options.threshold, accuracy_cut_m=2 * options.threshold)
    reference = _reference(options.reference, settings.voxel_m, options.range_min)
    scores = score_mesh(mesh, reference, settings)
    if options.json:
        print_line(json_text(scores))
    else:
        print_rows(str(options.mesh), _rows(scores))
    return OK


def _reference(path: Path, voxel_m: float, range_min_m: float) -> Doubles:
    """Return the points ``[N, 3]`` of a cloud, or of all scans of a folder in the world frame."""
    if path.is_dir():
        folder = read_cloud_folder(path)
        clouds = (_world_points(scan, range_min_m) for scan in folder.read(range(len(folder))))
        points = merged(clouds, voxel_m)
    else:
        points = np.asarray(read_mesh(path).vertices, np.float64)
    if not len(points):
        raise ToolError(f"{path}: holds no points")
    return points


def _world_points(scan: PosedScan, range_min_m: float) -> Doubles:
    """Return the finite points ``[N, 3]`` of a scan that are no nearer than this, world frame."""
    points = points_in_range(scan.points, range_min_m)
    return moved(points[np.isfinite(points).all(axis=1)], scan.world_from_sensor)


def _rows(scores: MeshScores) -> list[Row]:
    return [
        Row(
            "accuracy",
            f"{100 * scores.accuracy_m:.2f} cm",
            "mean, mesh to truth, outliers left out",
        ),
        Row("accuracy, median", f"{100 * scores.accuracy_median_m:.2f} cm"),
        Row("accuracy ratio", f"{100 * scores.accuracy_ratio:.2f} %", "outliers left out"),
        Row("completion", f"{100 * scores.completion_m:.2f} cm", "mean, truth to mesh"),
        Row("completion ratio", f"{100 * scores.completion_ratio:.2f} %"),
        Row("F-score", f"{100 * scores.f_score:.2f} %", "of both ratios"),
        Row("outliers", f"{100 * scores.outlier_ratio:.2f} %", "mesh beyond the accuracy cut"),
    ]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=_COMMAND,
        description="Score a mesh against true surface points.",
        epilog="Exit status: 0 done, 2 wrong usage or input.",
    )
    add = parser.add_argument
    add("mesh", type=Path, metavar="MESH", help=".ply or .glb")
    reference = "true surface points: a .ply file, or a folder of scans"
    add("--reference", type=Path, required=True, metavar="PATH", help=reference)
    near = "nearer than this is right; twice as far is an outlier (default: 0.1)"
    add("--threshold", type=positive, default=0.1, metavar="M", help=near)
    nearer = "leave out nearer points of a folder's scans (default: 0)"
    add("--range-min", type=not_negative, default=0.0, metavar="M", help=nearer)
    add("--json", action="store_true", help="print JSON")
    return parser


if __name__ == "__main__":
    sys.exit(main())
