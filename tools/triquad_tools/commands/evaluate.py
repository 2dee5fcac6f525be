"""``triquad-eval``: how good a mesh or a map is."""

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from triquad_client import Mesh
from triquad_format.records.arrays import Doubles

from triquad_tools.console.arguments import (
    add_version,
    count,
    not_negative,
    picture,
    positive,
    seed,
)
from triquad_tools.console.command import OK, ToolError, run
from triquad_tools.console.lines import print_line
from triquad_tools.console.progress import progress
from triquad_tools.console.report import Row, json_text, print_rows
from triquad_tools.console.server_arguments import DEFAULT_MAP, add_config
from triquad_tools.evaluation.map_scores import (
    WithheldAnswer,
    WithheldScores,
    ask_withheld,
    score_street,
    score_withheld,
    street_probes,
)
from triquad_tools.evaluation.metrics import (
    STREET_SETTINGS,
    MeshScores,
    ScoreSettings,
    Truth,
    cloud_truth,
    compare_mesh,
    drive_truth,
    scene_truth,
    scored_box,
)
from triquad_tools.evaluation.open_map import newest_epoch, open_map
from triquad_tools.evaluation.score_rows import TRUSTED, mesh_rows, street_rows, withheld_rows
from triquad_tools.mapfiles.meshfile import read_mesh
from triquad_tools.mapfiles.source import Access, is_endpoint
from triquad_tools.recordings.cloud import is_withheld, merged, world_points
from triquad_tools.recordings.folders.kitti import read_kitti_folder
from triquad_tools.simulation.street import street_drive

_COMMAND = "triquad-eval"
# Lines of the table that a picture has, too.
_DRAWN = ("F-score", "accuracy", "accuracy ratio", "completion", "completion ratio", "outliers")
_SEED = 0  # of the points that are drawn; scores can be repeated

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


def evaluate_mesh(options: argparse.Namespace) -> Results:
    """Return scores of a mesh file against a cloud, a folder of scans or a simulated street."""
    mesh = read_mesh(options.mesh)
    if not len(mesh.faces):
        raise ToolError(f"{options.mesh}: has no faces; a cloud can only be a --reference")
    settings = ScoreSettings(
        threshold_m=options.threshold,
        accuracy_cut_m=options.accuracy_cut,
        completion_cut_m=options.completion_cut,
        voxel_m=options.voxel,
    )
    if options.street is None:
        reference = _reference(options.reference, settings.voxel_m, options.range_min)
        truth = cloud_truth(reference, settings)
    else:
        drive = street_drive(options.street, options.scans, options.step)
        truth = scene_truth(drive.scene, drive.true_hits(settings.voxel_m), settings)
    return {"mesh": _compared(options, str(options.mesh), mesh, truth=truth, settings=settings)}


def evaluate_map(options: argparse.Namespace) -> Results:
    """Return scores of a map against a simulated street, or at scans that were withheld from it."""
    return _at_withheld(options) if options.street is None else _on_street(options)


def _on_street(options: argparse.Namespace) -> Results:
    drive = street_drive(options.street, options.scans, options.step)
    probes = street_probes(drive, np.random.default_rng(_SEED))
    truth = drive_truth(drive, STREET_SETTINGS)
    with open_map(options.target, Access(options.map, options.config)) as opened:
        street = score_street(opened.query_sdf, probes)
        mesh = opened.mesh(scored_box(truth.points, STREET_SETTINGS))
    name = f"{_map_name(options)}, epoch {mesh.epoch}"
    return {
        "street": street,
        "mesh": _compared(options, name, mesh, truth=truth, settings=STREET_SETTINGS),
    }


def _compared(
    options: argparse.Namespace, name: str, mesh: Mesh, *, truth: Truth, settings: ScoreSettings
) -> MeshScores:
    """Return scores of a mesh, which ``--plot`` draws."""
    comparison = compare_mesh(mesh, truth, settings)
    if options.plot is not None:
        from triquad_tools.plots.error_picture import draw_mesh_errors  # slow to import

        against = f"street {options.street}" if options.street is not None else options.reference
        rows = [row for row in mesh_rows(comparison.scores) if row.name in _DRAWN]
        with progress("drawing"):
            title = f"{name}, against {against}\n{_summary(rows)}"
            draw_mesh_errors(title, comparison, options.plot)
    return comparison.scores


def _summary(rows: Sequence[Row]) -> str:
    return " · ".join(f"{row.name} {row.value}" for row in rows)


def _map_name(options: argparse.Namespace) -> str:
    server = is_endpoint(options.target)
    return f"map {options.map!r} of {options.target}" if server else str(options.target)


def _at_withheld(options: argparse.Namespace) -> Results:
    folder = read_kitti_folder(options.withheld)
    every = options.skip_every
    indices = [i for i in range(len(folder)) if every == 0 or is_withheld(i, every)]
    if not indices:
        raise ToolError(
            f"{options.withheld}: --skip-every {every} withholds none of its {len(folder)} scans; "
            "use a smaller number"
        )
    limits = (options.range_min, options.range_max)
    with open_map(options.target, Access(options.map, options.config)) as opened:
        clouds = (world_points(scan, *limits) for scan in folder.read(indices))
        answers = ask_withheld(opened.query_sdf, clouds)
        if options.plot is None:
            return {"withheld": score_withheld(answers)}
        kept = list(answers)
        name = f"{_map_name(options)}, epoch {newest_epoch(opened)}"
    return {"withheld": _drawn(options, name, kept)}


def _drawn(options: argparse.Namespace, name: str, answers: list[WithheldAnswer]) -> WithheldScores:
    """Return scores at withheld scans, drawn into ``--plot``."""
    from triquad_tools.plots.error_picture import draw_withheld  # slow to import

    scores = score_withheld(answers)
    summary = _summary([row for row in withheld_rows(scores) if row.note != TRUSTED])
    title = f"{name}, at withheld scans of {options.withheld}\n{summary}"
    with progress("drawing"):
        draw_withheld(title, answers, scores, path=options.plot)
    return scores


def _reference(path: Path, voxel_m: float, range_min_m: float) -> Doubles:
    """Return the points ``[N, 3]`` of a cloud, or of all scans of a folder in the world frame."""
    if path.is_dir():
        folder = read_kitti_folder(path)
        clouds = (world_points(scan, range_min_m) for scan in folder.read(range(len(folder))))
        points = merged(clouds, voxel_m)
    else:
        points = np.asarray(read_mesh(path).vertices, np.float64)
    if not len(points):
        raise ToolError(f"{path}: holds no points")
    return points


_TABLES: dict[str, tuple[str, Callable[[Any], list[Row]]]] = {
    "mesh": ("Mesh", mesh_rows),
    "street": ("Map, against the exact street", street_rows),
    "withheld": ("Map, at the points of withheld scans", withheld_rows),
}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=_COMMAND,
        description="Score a mesh or a map. docs/tools.md defines the figures.",
        epilog="Exit status: 0 done, 1 the server failed, 2 wrong usage or input.",
    )
    kinds = parser.add_subparsers(required=True, metavar="{mesh,map}")
    _add_mesh(kinds.add_parser("mesh", help="score a mesh file"))
    _add_map(kinds.add_parser("map", help="score a map file, or the map of a running server"))
    add_version(parser)
    return parser


def _add_mesh(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(evaluate=evaluate_mesh)
    add = parser.add_argument
    add("mesh", type=Path, metavar="MESH", help=".ply or .glb")
    truth = parser.add_mutually_exclusive_group(required=True)
    truth.add_argument(
        "--reference",
        type=Path,
        metavar="PATH",
        help="true surface points: a .ply file, or a KITTI-style folder of scans",
    )
    _add_street(parser, truth)
    add("--threshold", type=positive, default=0.1, metavar="M", help="default: 0.1")
    add("--accuracy-cut", type=positive, default=0.2, metavar="M", help="default: 0.2")
    add("--completion-cut", type=positive, default=2.0, metavar="M", help="default: 2")
    add("--voxel", type=positive, default=0.02, metavar="M", help="thinning (default: 0.02)")
    add(
        "--range-min",
        type=not_negative,
        default=0.0,
        metavar="M",
        help="leave out nearer points of a folder's scans (default: 0)",
    )


def _add_map(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(evaluate=evaluate_map)
    add = parser.add_argument
    add("target", metavar="MAP", help="map file, or endpoint of a server (tcp/HOST:PORT)")
    add("--map", default=DEFAULT_MAP, metavar="NAME", help="map of the server (default: default)")
    add_config(parser)
    truth = parser.add_mutually_exclusive_group(required=True)
    truth.add_argument(
        "--withheld",
        type=Path,
        metavar="FOLDER",
        help="KITTI-style folder with scans that the map has not seen",
    )
    _add_street(parser, truth)
    add(
        "--skip-every",
        type=count,
        default=0,
        metavar="N",
        help="as given to triquad-replay: score at every Nth scan only (default: at all)",
    )
    add("--range-min", type=not_negative, default=0.0, metavar="M", help="default: 0")
    add("--range-max", type=positive, default=50.0, metavar="M", help="default: 50")


def _add_street(parser: argparse.ArgumentParser, truth: Any) -> None:
    truth.add_argument("--street", type=seed, metavar="SEED", help="the simulated street")
    add = parser.add_argument
    add("--scans", type=count, default=60, metavar="N", help="of the drive (default: 60)")
    add("--step", type=positive, default=1.0, metavar="M", help="between them (default: 1)")
    add("--plot", type=picture, metavar="OUT.png", help="draw the errors, and what is missing")
    add("--json", action="store_true", help="print JSON")
