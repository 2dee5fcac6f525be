"""``triquad-demo``: the whole of triquad on one simulated street."""

import argparse
import shutil
import sys
import threading
from collections.abc import Sequence
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path

from triquad_server import serve

from triquad_tools.console.arguments import command_parser, count, port, seed
from triquad_tools.console.command import FAILED, OK, print_line, print_remark, run
from triquad_tools.console.report import json_text, print_rows
from triquad_tools.demo.steps import MAP, DemoResults, broken_promises, demonstrate, table_rows
from triquad_tools.simulation.street import street_drive
from triquad_tools.viewer.sources import LiveSource
from triquad_tools.viewer.viewer import DEFAULT_PORT, Viewer

_COMMAND = "triquad-demo"

_WATCHED_PERIOD_S = 0.3  # between two scans, a metre apart, so that the map is seen to grow


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool: 0 all is as promised, 1 something is not or failed, 2 wrong usage."""
    work = partial(_demo, _parser().parse_args(argv))
    interrupted = "interrupted; the server is stopped"
    return run(_COMMAND, work, interrupted=interrupted)


def _demo(options: argparse.Namespace) -> int:
    """Map a street, and leave all results in a folder; the server stops in any case."""
    out: Path = options.out
    out.mkdir(parents=True, exist_ok=True)
    # What an earlier demonstration left in its store is removed.
    shutil.rmtree(out / "store" / MAP, ignore_errors=True)
    print_remark("starting a server (the first run of all compiles for half a minute or more) ...")
    with ExitStack() as opened:
        server = opened.enter_context(serve(store=out / "store", map=MAP))
        client = opened.enter_context(server.client())
        if options.view:
            source = LiveSource(client, server.endpoint)
            viewer = opened.enter_context(closing(Viewer(source, "127.0.0.1", options.port)))
            print_remark(f"open {viewer.url} in a browser: then the drive begins")
            viewer.wait_for_browser()
        drive = street_drive(options.seed, options.scans)
        period_s = _WATCHED_PERIOD_S if options.view else 0.0
        results = demonstrate(client, server.endpoint, drive, out, period_s)
        status = _report(out, results)
        if options.view:
            print_remark("the page shows what the server has now; Ctrl-C ends both")
            threading.Event().wait()
    return status


def _report(out: Path, results: DemoResults) -> int:
    (out / "results.json").write_text(json_text(results) + "\n", encoding="utf-8")
    print_rows(f"Street {results.seed}, {results.intake.scans} scans", table_rows(results))
    print_line(f"In {out}: map.triquad, street.glb, street.ply, street.png, results.json")
    # With its folder, if that is not on the path.
    view = shutil.which("triquad-view") or Path(sys.executable).parent / "triquad-view"
    print_line(f"To look at the map in a browser: {view} {out / 'map.triquad'}")
    broken = broken_promises(results)
    for line in broken:
        print_remark(f"{_COMMAND}: {line}")
    return FAILED if broken else OK


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        _COMMAND,
        description="Map a simulated street with a real server, and ask it while it learns. Takes "
        "some minutes.",
        epilog="Exit status: 0 all is as promised, 1 something is not or failed, 2 wrong usage.",
    )
    add = parser.add_argument
    add("--out", type=Path, default=Path("demo-out"), metavar="DIR", help="default: demo-out")
    add("--scans", type=count, default=60, metavar="N", help="a metre apart (default: 60)")
    add("--view", action="store_true", help="show in a browser how the street grows")
    of_page = f"of that page ({DEFAULT_PORT})"
    add("--port", type=port, default=DEFAULT_PORT, metavar="N", help=of_page)
    add("--seed", type=seed, default=1, metavar="N", help="of the street (default: 1)")
    return parser
