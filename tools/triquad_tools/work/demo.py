"""``triquad-demo``: the whole of triquad on one simulated street."""

import argparse
import shutil
import sys
import threading
from contextlib import ExitStack, closing
from pathlib import Path

from triquad_server import serve

from triquad_tools.commands.demo import COMMAND
from triquad_tools.console.command import FAILED, OK, print_line, print_remark
from triquad_tools.console.report import json_text, print_rows
from triquad_tools.demo.steps import MAP, DemoResults, broken_promises, demonstrate, table_rows
from triquad_tools.simulation.street import street_drive
from triquad_tools.viewer.sources import LiveSource
from triquad_tools.viewer.viewer import Viewer

_WATCHED_PERIOD_S = 0.3  # between two scans, a metre apart, so that the map is seen to grow


def work(options: argparse.Namespace) -> int:
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
        print_remark(f"{COMMAND}: {line}")
    return FAILED if broken else OK
