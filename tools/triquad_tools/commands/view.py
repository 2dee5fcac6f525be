"""``triquad-view``: a map in the browser, as it grows, or as a file or a store has it."""

import argparse
from functools import partial
from pathlib import Path

from triquad_tools.console.arguments import PAGE_PORT, add_server, command_parser, port
from triquad_tools.console.command import run_work

COMMAND = "triquad-view"


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        COMMAND,
        description="Show a map in the browser: of a server, as it grows, or of a file.",
        epilog="Exit status: 130 ended by Ctrl-C, 1 the server failed, 2 wrong usage or input.",
    )
    add = parser.add_argument
    file = "a map file, or a store with its history, to be shown without a server"
    add("file", type=Path, nargs="?", metavar="FILE_OR_STORE", help=file)
    add_server(parser)
    add("--host", default="127.0.0.1", metavar="ADDRESS", help="to serve the page at")
    name = "also answer where the page is asked for under this name, as behind a proxy; repeat for "
    name += "more (addresses and the machine's host name are)"
    add("--allow-host", action="append", default=[], metavar="NAME", help=name)
    add("--port", type=port, default=PAGE_PORT, metavar="PORT", help=f"default: {PAGE_PORT}")
    return parser


main = partial(run_work, "view", _parser)
