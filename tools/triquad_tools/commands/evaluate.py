"""``triquad-eval``: how good a mesh or a map is."""

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from triquad_format.records.arrays import Doubles

from triquad_tools.console.arguments import add_version, count, not_negative, positive
from triquad_tools.console.command import OK, ToolError, run
from triquad_tools.console.lines import print_line
from triquad_tools.console.report import Row, json_text, print_rows
from triquad_tools.console.server_arguments import DEFAULT_MAP, add_config
from triquad_tools.evaluation.metrics import ScoreSettings, score_mesh
from triquad_tools.evaluation.score_rows import mesh_rows, withheld_rows
from triquad_tools.evaluation.withheld_scores import score_withheld
from triquad_tools.mapfiles.meshfile import read_mesh
from triquad_tools.mapfiles.source import Access, open_map
from triquad_tools.recordings.cloud import is_withheld, merged, world_points
from triquad_tools.recordings.folders.cloud_folder import read_cloud_folder

_COMMAND = "triquad-eval"

Results = dict[str, Any]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool: 0 done, 1 a server failed, 2 wrong usage or input that cannot be used."""
    return run(_COMMAND, partial(_evaluate, _parser().parse_args(argv)))


def _evaluate(options: argparse.Namespace) -> int:
    results: Results = options.evaluate(options)
    if options.json:
        print_line(json_text(results))
        return OK
    for name, scores in results.items():
        title, rows = _TABLES[name]
        print_rows(title, rows(scores))
    return OK


def _evaluate_mesh(options: argparse.Namespace) -> Results:
    """Return scores of a mesh file against a cloud or a folder of scans."""
    mesh = read_mesh(options.mesh)
    if not len(mesh.faces):
        raise ToolError(f"{options.mesh}: has no faces; a cloud can only be a --reference")
    settings = ScoreSettings(options.threshold, accuracy_cut_m=2 * options.threshold)
    reference = _reference(options.reference, settings.voxel_m, options.range_min)
    return {"mesh": score_mesh(mesh, reference, settings)}


def _evaluate_map(options: argparse.Namespace) -> Results:
    """Return scores of a map at scans that were withheld from it."""
    folder = read_cloud_folder(options.withheld)
    every = options.skip_every
    indices = [i for i in range(len(folder)) if every == 0 or is_withheld(i, every)]
    if not indices:
        raise ToolError(
            f"{options.withheld}: --skip-every {every} withholds none of its {len(folder)} scans; "
            "use a smaller number"
        )
    with open_map(options.target, Access(options.map, options.config)) as opened:
        limits = (options.range_min, options.range_max)
        clouds = (world_points(scan, *limits) for scan in folder.read(indices))
        return {"withheld": score_withheld(opened.query_sdf, clouds)}


def _reference(path: Path, voxel_m: float, range_min_m: float) -> Doubles:
    """Return the points ``[N, 3]`` of a cloud, or of all scans of a folder in the world frame."""
    if path.is_dir():
        folder = read_cloud_folder(path)
        clouds = (world_points(scan, range_min_m) for scan in folder.read(range(len(folder))))
        points = merged(clouds, voxel_m)
    else:
        points = np.asarray(read_mesh(path).vertices, np.float64)
    if not len(points):
        raise ToolError(f"{path}: holds no points")
    return points


_TABLES: dict[str, tuple[str, Callable[[Any], list[Row]]]] = {
    "mesh": ("Mesh", mesh_rows),
    "withheld": ("Map, at the points of withheld scans", withheld_rows),
}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=_COMMAND,
        description="Score a mesh or a map. docs/tools.md defines the figures.",
        epilog="Exit status: 0 done, 1 the server failed, 2 wrong usage or input.",
    )
    kinds = parser.add_subparsers(required=True, metavar="{mesh,map}")
    mesh = kinds.add_parser("mesh", help="score a mesh file")
    mesh.set_defaults(evaluate=_evaluate_mesh)
    mesh.add_argument("mesh", type=Path, metavar="MESH", help=".ply or .glb")
    reference = "true surface points: a .ply file, or a folder of scans"
    _add_scans(mesh, "--reference", reference)
    near = "nearer than this is right; twice as far is an outlier (default: 0.1)"
    mesh.add_argument("--threshold", type=positive, default=0.1, metavar="M", help=near)
    of_map = kinds.add_parser("map", help="score a map file, or the map of a running server")
    of_map.set_defaults(evaluate=_evaluate_map)
    add = of_map.add_argument
    add("target", metavar="MAP", help="map file, or endpoint of a server (tcp/HOST:PORT)")
    add("--map", default=DEFAULT_MAP, metavar="NAME", help="map of the server (default: default)")
    add_config(of_map)
    _add_scans(of_map, "--withheld", "folder with scans that the map has not seen")
    every = "as given to triquad-replay: score at every Nth scan only (default: at all)"
    add("--skip-every", type=count, default=0, metavar="N", help=every)
    add("--range-max", type=positive, default=50.0, metavar="M", help="default: 50")
    add_version(parser)
    return parser


def _add_scans(parser: argparse.ArgumentParser, flag: str, what: str) -> None:
    add = parser.add_argument
    add(flag, type=Path, required=True, metavar="PATH", help=what)
    nearer = "leave out nearer points of a folder's scans (default: 0)"
    add("--range-min", type=not_negative, default=0.0, metavar="M", help=nearer)
    add("--json", action="store_true", help="print JSON")
