"""``triquad-eval``: how good a mesh is."""

import argparse
from functools import partial
from pathlib import Path

from triquad_tools.console.arguments import command_parser, not_negative, positive
from triquad_tools.console.command import run_work


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "triquad-eval",
        description="Score a mesh against true surface points. docs/tools.md defines the figures.",
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


main = partial(run_work, "evaluate", _parser)
