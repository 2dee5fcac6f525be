"""``triquad-view``: a map in the browser, as it grows."""

import argparse
import threading
from collections.abc import Sequence
from functools import partial

import triquad_client
from triquad_format.wire.endpoints import DEFAULT_ENDPOINT

from triquad_tools.console.arguments import add_version
from triquad_tools.console.command import OK, run
from triquad_tools.viewer.live_source import LiveSource
from triquad_tools.viewer.viewer import DEFAULT_PORT, Viewer

_COMMAND = "triquad-view"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool until it is interrupted: 130 then, 1 the server failed, 2 bad input."""
    return run(_COMMAND, partial(_view, _parser().parse_args(argv)))


def _view(options: argparse.Namespace) -> int:
    with triquad_client.connect(options.connect, options.map, config=options.config) as client:
        viewer = Viewer(LiveSource(client, options.connect), options.host, options.port)
        print(f"open {viewer.url} in a browser; Ctrl-C ends it", flush=True)
        try:
            threading.Event().wait()
        finally:
            viewer.close()
    return OK


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=_COMMAND, description="Show a map in the browser, as it grows."
    )
    add = parser.add_argument
    add("--connect", default=DEFAULT_ENDPOINT, metavar="ENDPOINT", help="of the server")
    add("--map", default="default", metavar="NAME", help="default: default")
    add("--config", metavar="FILE", help="Zenoh configuration (JSON5), for TLS or credentials")
    add("--host", default="127.0.0.1", metavar="ADDRESS", help="to serve the page at")
    add("--port", type=int, default=DEFAULT_PORT, metavar="PORT", help=f"default: {DEFAULT_PORT}")
    add_version(parser)
    return parser
