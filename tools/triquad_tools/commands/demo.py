"""``triquad-demo``: the whole of triquad on one simulated street."""

import argparse
from functools import partial
from pathlib import Path

from triquad_tools.console.arguments import PAGE_PORT, command_parser, count, port, seed
from triquad_tools.console.command import run_work

COMMAND = "triquad-demo"


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        COMMAND,
        description="Map a simulated street with a real server, and ask it while it learns. Takes "
        "some minutes.",
        epilog="Exit status: 0 all is as promised, 1 something is not or failed, 2 wrong usage.",
    )
    add = parser.add_argument
    add("--out", type=Path, default=Path("demo-out"), metavar="DIR", help="default: demo-out")
    add("--scans", type=count, default=60, metavar="N", help="a metre apart (default: 60)")
    add("--view", action="store_true", help="show in a browser how the street grows")
    of_page = f"of that page ({PAGE_PORT})"
    add("--port", type=port, default=PAGE_PORT, metavar="N", help=of_page)
    add("--seed", type=seed, default=1, metavar="N", help="of the street (default: 1)")
    return parser


main = partial(run_work, "demo", _parser, interrupted="interrupted; the server is stopped")
