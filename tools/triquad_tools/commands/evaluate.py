"""``triquad-eval``: how good a mesh is, and the experiments of the 3QFP paper."""

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from triquad_tools.console.arguments import command_parser, not_negative, positive, whole
from triquad_tools.console.command import run_work

_PAPER = "paper"


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "triquad-eval",
        description="Score a mesh against true surface points. docs/tools.md defines the figures.",
        epilog="triquad-eval paper --help: how to make the experiments of the 3QFP paper. "
        "Exit status: 0 done, 2 wrong usage or input.",
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


def _paper_parser() -> argparse.ArgumentParser:
    parser = command_parser(
        f"triquad-eval {_PAPER}",
        description="Make the experiments of the 3QFP paper with a folder of scans: dense input, "
        "each n-th scan, memory by number of scans, and the ablation. OUT gets report.md, "
        "report.json and pictures. VDBFusion and Open3D are run as well where they are installed.",
        epilog="Exit status: 0 done, 2 wrong usage or input.",
    )
    add = parser.add_argument
    add("folder", type=Path, metavar="FOLDER", help="scans and poses, as of KITTI or MaiCity")
    add("output", type=Path, metavar="OUT", help="folder for the report; it must not exist")
    reference = "true surface: a .ply file of points, or a folder of scans"
    add("--reference", type=Path, required=True, metavar="PATH", help=reference)
    style = "which set of the paper it is like: thresholds, n, and published figures"
    add("--style", choices=("maicity", "newer-college"), required=True, help=style)
    every = "use each n-th scan, for each of these n (default: those of the paper's plots)"
    add("--every", type=partial(whole, 1, 1000), nargs="+", metavar="N", help=every)
    published = "also map as published: projective labels, its sampling, random initial weights"
    add("--as-published", action="store_true", help=published)
    samples = "train maps as published on this number of samples (default: 20,000,000; three times "
    samples += "as many gained 0.4 points of F on a simulated street)"
    add("--samples", type=partial(whole, 1, None), default=20_000_000, metavar="N", help=samples)
    drawn = "points that are drawn of a mesh (default: 10,000,000)"
    add("--mesh-samples", type=partial(whole, 1, None), default=10_000_000, metavar="N", help=drawn)
    spacing = "thin the mesh's samples and the truth to this (default: 0.02)"
    add("--spacing", type=positive, default=0.02, metavar="M", help=spacing)
    settings = "TOML file with settings of the server, for maps by triquad's own choices"
    add("--settings", type=Path, metavar="FILE", help=settings)
    add("--set", action="append", default=[], metavar="NAME=VALUE", help="set one of these")
    add("--name", default=None, metavar="TEXT", help="heading of the report (default: FOLDER)")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status of the command with these arguments, or those of the process."""
    arguments = sys.argv[1:] if argv is None else list(argv)
    if arguments[:1] == [_PAPER]:
        return run_work("paper", _paper_parser, arguments[1:])
    return run_work("evaluate", _parser, arguments)
