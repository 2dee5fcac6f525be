"""``triquad-inspect``: what maps hold, whether their files are valid, and how they differ."""

import argparse
from functools import partial
from pathlib import Path

from triquad_tools.console.arguments import add_config, command_parser, picture
from triquad_tools.console.command import run_work

COMMAND = "triquad-inspect"


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        COMMAND,
        description="Show what a map file holds, a folder's history, or how two maps differ. Map "
        "files are read in full and checked.",
        epilog="Exit status: 0 valid, also where maps differ; 1 damaged, or the server failed; "
        "2 not readable (missing, or of a newer version), or wrong usage.",
    )
    add = parser.add_argument
    maps = "map file; folder of checkpoints, of which the newest is meant; or endpoint of a "
    maps += "server, such as tcp/127.0.0.1:7447, whose map is fetched"
    add("files", type=Path, nargs="+", metavar="FILE", help=maps)
    add("--map", metavar="NAME", help="of the server (default: default)")
    add_config(parser)
    at = "the newest checkpoint of the folder FILE that is not after this, such as 120 or "
    add("--at", metavar="EPOCH_OR_TIME", help=at + "2026-01-31T12:00:00Z")
    add("--log", action="store_true", help="list the checkpoints in the folder FILE")
    add("--diff", action="store_true", help="compare two map files, A and B")
    plot = "draw a picture of the map, or plans of the difference"
    add("--plot", type=picture, metavar="OUT.png", help=plot)
    add("--json", action="store_true", help="print JSON")
    return parser


main = partial(run_work, "inspect", _parser, intermixed=True)
