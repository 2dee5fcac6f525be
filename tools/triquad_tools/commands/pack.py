"""``triquad-pack``: rewrite a map file: smaller, from history, repaired, or as something else."""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

from triquad_tools.console.arguments import SCANS_SUFFIX, SUFFIXES, add_fill, command_parser, within
from triquad_tools.console.command import run_work

COMMAND = "triquad-pack"
_CELL_RANGE_M = (0.01, 10.0)
_ERROR_RANGE_M = (1e-5, 0.1)
_POSE_RANGE = (-1e8, 1e8)  # metres, or degrees: coordinates of the Earth's grids are within
_Add = Callable[..., argparse.Action]


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        COMMAND,
        description="Rewrite a map file: smaller, cropped, an earlier epoch of it, what is intact "
        "of it, joined with another map, in the newest version, or as a mesh (.ply, .glb, .obj, "
        ".stl), a picture (.png), a map of Nav2 (.yaml, with a .pgm), an OctoMap (.bt) or "
        "arrays of numpy (.npz).",
        epilog="Exit status: 0 done; 1 IN is damaged (with --recover: something of it is lost), or "
        "nothing lies in the box; 2 wrong usage, or input that cannot be used.",
    )
    _add_source(parser.add_argument)
    _add_content(parser.add_argument)
    _add_target(parser.add_argument)
    add_fill(parser)
    return parser


def _add_source(add: _Add) -> None:
    add("input", type=Path, metavar="IN", help="map file, or folder of checkpoints")
    ends = ", ".join(SUFFIXES)
    scans = f"its name ends in {ends}, or {SCANS_SUFFIX}: the scans that a server kept in IN"
    add("output", type=Path, metavar="OUT", help=scans)
    at = "take the newest checkpoint of the folder IN that is not after this, such as 120 or "
    at += "2026-01-31T12:00:00Z (default: the newest of all)"
    add("--at", metavar="EPOCH_OR_TIME", help=at)
    add("--recover", action="store_true", help="save what is intact of a damaged file")
    other = "join another map of the same frame (or see --align); what both know is learnt again"
    add("--merge", type=Path, metavar="OTHER", help=other)
    guess = (
        "about where the frame of OTHER is in that of IN, metres and degrees; at what both know "
    )
    guess += "within 2 m and 10 degrees. OTHER is moved to where the surfaces of both fit"
    add(
        "--align",
        type=partial(within, *_POSE_RANGE),
        nargs=4,
        metavar=("X", "Y", "Z", "YAW"),
        help=guess,
    )


def _add_content(add: _Add) -> None:
    error = "features as coarse integers as move 99 %% of distances by less than this, such as "
    error += "0.002; drops training state"
    add("--max-error", type=partial(within, *_ERROR_RANGE_M), metavar="M", help=error)
    corners = ("XMIN", "YMIN", "ZMIN", "XMAX", "YMAX", "ZMAX")
    box = "keep what answers in this box need, metres, map frame: only that is read, and training "
    box += "state is dropped"
    add("--crop", type=float, nargs=6, metavar=corners, help=box)
    add("--no-training", action="store_true", help="drop what only further training needs")


def _add_target(add: _Add) -> None:
    cell = "side of cells of a mesh, a picture or a map of Nav2 (default: half a leaf), or of "
    cell += "arrays (default: a leaf)"
    add("--cell", type=partial(within, *_CELL_RANGE_M), metavar="M", help=cell)
    add("--force", action="store_true", help="replace OUT where it exists")


main = partial(run_work, "pack", _parser)
