"""``triquad-view``: a map in the browser, as it grows, or as a file or a store has it."""

import argparse
import threading
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path

from triquad_tools.console.arguments import (
    add_server,
    command_parser,
    connect_to,
    port,
    server_name,
)
from triquad_tools.console.command import OK, complain, print_line, refuse, run
from triquad_tools.console.progress import progress
from triquad_tools.viewer.sources import History, LiveSource, MapSource, StoredMap, moment
from triquad_tools.viewer.viewer import DEFAULT_PORT, Viewer

_COMMAND = "triquad-view"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool until it is interrupted: 130 then, 1 the server failed, 2 bad input."""
    return run(_COMMAND, partial(_view, _parser().parse_args(argv)))


def _view(options: argparse.Namespace) -> int:
    server = options.connect or options.map or options.config
    problem = "--connect, --map and --config are for a server, not for a file"
    refuse({problem: options.file and server})
    with _shown(options) as shown:
        viewer = Viewer(shown, options.host, options.port, allowed_hosts=options.allow_host)
        with closing(viewer):
            print_line(f"open {viewer.url} in a browser; Ctrl-C ends it")
            threading.Event().wait()
    return OK


@contextmanager
def _shown(options: argparse.Namespace) -> Iterator[MapSource | History]:
    if options.file is None:
        with connect_to(options) as client:
            yield LiveSource(client, server_name(options))
    elif options.file.is_dir():
        yield _store(options.file)
    else:
        with progress(f"opening {options.file}") as report:
            stored = StoredMap(options.file, options.file.name)
            report(1, _name(stored))
        yield stored


def _store(path: Path) -> History:
    """Return the checkpoints of a store, of which the newest that can be shown is opened."""
    history = History(path)
    with progress(f"opening {path}") as report:
        report(1, _name(history.newest()))
    for problem in history.damaged():
        complain(_COMMAND, problem, OK)
    files = history.files()
    print_line(f"{len(files)} checkpoints: {moment(files[0])} to {moment(files[-1])}")
    return history


def _name(shown: StoredMap) -> str:
    return f"map {shown.queries.name!r}, epoch {shown.queries.epoch}"


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        _COMMAND, description="Show a map in the browser: of a server, as it grows, or of a file."
    )
    add = parser.add_argument
    file = "a map file, or a store with its history, to be shown without a server"
    add("file", type=Path, nargs="?", metavar="FILE_OR_STORE", help=file)
    add_server(parser)
    add("--host", default="127.0.0.1", metavar="ADDRESS", help="to serve the page at")
    name = "also answer where the page is asked for under this name, as behind a proxy; repeat for "
    name += "more (addresses and the machine's host name are)"
    add("--allow-host", action="append", default=[], metavar="NAME", help=name)
    add("--port", type=port, default=DEFAULT_PORT, metavar="PORT", help=f"default: {DEFAULT_PORT}")
    return parser
