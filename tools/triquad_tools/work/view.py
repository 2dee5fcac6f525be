"""``triquad-view``: a map in the browser, as it grows, or as a file or a store has it."""

import argparse
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from triquad_tools.commands.view import COMMAND
from triquad_tools.console.arguments import connect_to, server_name
from triquad_tools.console.command import OK, complain, print_line, refuse
from triquad_tools.console.progress import progress
from triquad_tools.viewer.sources import FileSource, History, LiveSource, MapSource, moment
from triquad_tools.viewer.viewer import Viewer


def work(options: argparse.Namespace) -> int:
    """Serve a page that shows a map."""
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
            stored = FileSource(options.file, options.file.name)
            report(1, _name(stored))
        yield stored


def _store(path: Path) -> History:
    """Return the checkpoints of a store, of which the newest that can be shown is opened."""
    history = History(path)
    with progress(f"opening {path}") as report:
        report(1, _name(history.newest()))
    for problem in history.damaged():
        complain(COMMAND, problem, OK)
    files = history.files()
    print_line(f"{len(files)} checkpoints: {moment(files[0])} to {moment(files[-1])}")
    return history


def _name(shown: FileSource) -> str:
    return f"map {shown.queries.name!r}, epoch {shown.queries.epoch}"
