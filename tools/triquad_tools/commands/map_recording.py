"""``triquad-map``: a recording in, a map out."""

import argparse
from functools import partial
from pathlib import Path

from triquad_server.process.installed import DEVICES

from triquad_tools.console.arguments import SUFFIXES, add_fill, command_parser, count, not_negative
from triquad_tools.console.command import run_work
from triquad_tools.recordings.arguments import add_recording

COMMAND = "triquad-map"
_INTERRUPTED = "interrupted; the same command goes on where the map was saved last, and with "
_INTERRUPTED += "--train-for 0 it writes what is there"


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        COMMAND,
        description="Make a map of a recording, without a server or a network.",
        epilog="Exit status: 0 done; 1 the map could not be written; 2 wrong usage, or input of "
        "which nothing can be used; 130 interrupted: the same command then goes on where it was.",
    )
    add_recording(parser, several=True)
    add = parser.add_argument
    add("output", type=Path, metavar="OUT", help="its name ends in " + ", ".join(SUFFIXES))
    preset = "settings for a kind of place and sensor, such as indoor (docs/settings.md)"
    add("--preset", metavar="NAME", help=preset)
    add("--settings", type=Path, metavar="FILE", help="settings of the map, as of triquad-server")
    one = "one setting, such as field.leaf_m=0.05, repeatable"
    add("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help=one)
    add_fill(parser)
    add("--device", choices=DEVICES, default="cpu", help="what it trains on (default: cpu)")
    most = "train at most so long after the last scan, to see soon whether all is right; the same "
    most += "command without this and with --force goes on from there (default: until settled)"
    add("--train-for", type=not_negative, metavar="S", help=most)
    add("--training", action="store_true", help="keep what further training needs in the map file")
    of_machine = "map by this number of processes of this machine (extra cluster, docs/scale.md)"
    add("--workers", type=count, metavar="N", help=of_machine)
    scheduler = "map by the workers of a cluster of Dask, such as tcp://scheduler:8786"
    add("--cluster", metavar="ADDRESS", help=scheduler)
    add("--force", action="store_true", help="replace OUT where it exists")
    return parser


main = partial(run_work, "map_recording", _parser, interrupted=_INTERRUPTED)
