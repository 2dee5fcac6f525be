"""``triquad-demo``: the whole of triquad on one simulated street."""

import argparse
import shutil
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from triquad_client import connect

from triquad_tools.console.arguments import add_version, count, port, seed
from triquad_tools.console.command import FAILED, OK, ToolError, complain, run
from triquad_tools.console.interrupts import sigterm_interrupts
from triquad_tools.console.lines import print_line, print_remark
from triquad_tools.console.report import json_text, print_rows
from triquad_tools.demo import steps
from triquad_tools.demo.results import DemoResults, broken_promises, table_rows
from triquad_tools.demo.server import DemoServer, free_endpoint
from triquad_tools.evaluation.map_scores import driven_street
from triquad_tools.simulation.street import street_drive
from triquad_tools.viewer.sources.live_source import LiveSource
from triquad_tools.viewer.viewer import DEFAULT_PORT, Viewer

_COMMAND = "triquad-demo"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool: 0 all is as promised, 1 something is not or failed, 2 wrong usage."""
    work = partial(_demo, _parser().parse_args(argv))
    with sigterm_interrupts():
        return run(
            _COMMAND,
            work,
            failures=(ToolError, OSError),
            interrupted="interrupted; the server is stopped",
        )


def _demo(options: argparse.Namespace) -> int:
    with ExitStack() as opened:
        endpoint = free_endpoint()
        show = partial(_show, opened, options.port, endpoint)
        results = run_demo(
            options.out,
            options.scans,
            options.seed,
            endpoint=endpoint,
            started=show if options.view else None,
        )
        status = _report(options.out, results)
        if options.view:
            with DemoServer(options.out, steps.MAP, endpoint=endpoint):
                print_remark("the page shows what the server has now; Ctrl-C ends both")
                threading.Event().wait()
    return status


def _report(out: Path, results: DemoResults) -> int:
    print_rows(f"Street {results.seed}, {results.intake.scans} scans", table_rows(results))
    files = "map.triquad, street.glb, street.ply, street.png, results.json, server.log"
    print_line(f"In {out}: {files}")
    print_line(
        f"To look at the map in a browser: {_beside_python('triquad-view')} {out / 'map.triquad'}"
    )
    broken = broken_promises(results)
    for line in broken:
        complain(_COMMAND, line, FAILED)
    return FAILED if broken else OK


def _beside_python(command: str) -> str:
    """Return a command as it has to be typed: with its folder, if that is not on the path."""
    return command if shutil.which(command) else str(Path(sys.executable).parent / command)


def _show(opened: ExitStack, port: int, endpoint: str) -> None:
    """Serve a page that shows the server's map, and wait until a browser opens it."""
    client = opened.enter_context(connect(endpoint, steps.MAP))
    viewer = Viewer(LiveSource(client, endpoint), "127.0.0.1", port)
    opened.callback(viewer.close)
    print_remark(f"open {viewer.url} in a browser: the drive begins as soon as the page is there")
    viewer.wait_for_browser()


def run_demo(
    out: Path, scans: int, street_seed: int, *, endpoint: str, started: Callable[[], None] | None
) -> DemoResults:
    """Map a street of ``scans`` scans, and leave all results in the folder ``out``.

    Its servers listen on ``endpoint``; ``started`` is called once the first one serves.

    Raises:
        ToolError, TriquadError, FormatError, OSError: a step failed; the server is stopped.
    """
    out.mkdir(parents=True, exist_ok=True)
    # What an earlier demonstration left in its store and log is removed.
    shutil.rmtree(out / "store" / steps.MAP, ignore_errors=True)
    (out / "server.log").unlink(missing_ok=True)
    street = driven_street(street_drive(street_seed, scans))
    print_remark(
        "starting triquad-server (the first run of all compiles for half a minute or more) ..."
    )
    with DemoServer(out, steps.MAP, endpoint=endpoint) as server:
        if started is not None:
            started()
        learnt = steps.learn(server.endpoint, street)
        if not learnt.intake.settled:
            print_remark("the server is still learning; it is scored as it is now")
        scored = steps.score(server.endpoint, street, out)
        server.stop()
    results = DemoResults(
        street_seed,
        learnt.intake,
        learnt.queries,
        scored.street,
        scored.mesh,
        map_bytes=(out / "map.triquad").stat().st_size,
        parameters=scored.parameters,
    )
    (out / "results.json").write_text(json_text(results) + "\n", encoding="utf-8")
    return results


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=_COMMAND,
        description="Map a simulated street with a real server, ask it while it learns, and score "
        "the map against the exact street. Takes some minutes.",
        epilog="Exit status: 0 all is as the README promises, 1 something is not or failed, "
        "2 wrong usage.",
    )
    add = parser.add_argument
    add("--out", type=Path, default=Path("demo-out"), metavar="DIR", help="default: demo-out")
    add("--scans", type=count, default=60, metavar="N", help="a metre apart (default: 60)")
    add("--view", action="store_true", help="show in a browser how the street grows")
    of_page = f"of that page ({DEFAULT_PORT})"
    add("--port", type=port, default=DEFAULT_PORT, metavar="N", help=of_page)
    add("--seed", type=seed, default=1, metavar="N", help="of the street (default: 1)")
    add_version(parser)
    return parser
