"""``triquad-top``: how a map server is doing, live."""

import argparse
from functools import partial

from triquad_tools.console.arguments import add_server, command_parser, positive
from triquad_tools.console.command import run_work

COMMAND = "triquad-top"


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        COMMAND,
        description="Show how a map server is doing, as it goes, until Ctrl-C.",
        epilog="Exit status: 0 done, 1 there is no such server or it failed, 2 wrong usage, "
        "130 ended by Ctrl-C.",
    )
    add_server(parser)
    add = parser.add_argument
    add("--interval", type=positive, default=1.0, metavar="S", help="seconds (default: 1)")
    add("--once", action="store_true", help="print one page as plain text, after one interval")
    add("--json", action="store_true", help="print an object of JSON a line, one each interval")
    return parser


main = partial(run_work, "top", _parser)
