"""``triquad-demo``: the whole of triquad on one simulated street."""

import argparse
import os
import shutil
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from triquad_tools.console.arguments import add_version, count, seed
from triquad_tools.console.command import FAILED, OK, ToolError, complain, run
from triquad_tools.console.interrupts import sigterm_interrupts
from triquad_tools.console.report import json_text, print_rows
from triquad_tools.demo import steps
from triquad_tools.demo.results import DemoResults, broken_promises, table_rows
from triquad_tools.demo.server import DemoServer
from triquad_tools.evaluation.map_scores import driven_street
from triquad_tools.simulation.street import street_drive

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
    results = run_demo(options.out, options.scans, options.seed)
    print_rows(f"Street {results.seed}, {results.intake.scans} scans", table_rows(results))
    files = "map.triquad, street.glb, street.ply, street.png, results.json, server.log"
    print(f"In {options.out}: {files}")
    broken = broken_promises(results)
    for line in broken:
        complain(_COMMAND, line, FAILED)
    return FAILED if broken else OK


def run_demo(out: Path, scans: int, street_seed: int) -> DemoResults:
    """Map a street of ``scans`` scans, and leave all results in the folder ``out``.

    Raises:
        ToolError, TriquadError, FormatError, OSError: a step failed; the server is stopped.
    """
    laps = _Laps()
    out.mkdir(parents=True, exist_ok=True)
    # What an earlier demonstration left in its store and log is forgotten.
    shutil.rmtree(out / "store" / steps.MAP, ignore_errors=True)
    (out / "server.log").unlink(missing_ok=True)
    street = driven_street(street_drive(street_seed, scans))
    laps.end("simulate")
    _say("starting triquad-server (the first run of all compiles kernels: a minute more) ...")
    with DemoServer(out, steps.MAP) as server:
        laps.end("start")
        learnt = steps.learn(server.endpoint, street)
        laps.end("learn")
        if not learnt.intake.settled:
            _say("the server is still learning; it is scored as it is now")
        scored = steps.score(server.endpoint, street)
        laps.end("score")
        server.stop()
        laps.end("stop")
    _say("starting triquad-server again, from its checkpoint ...")
    with DemoServer(out, steps.MAP) as server:
        restart = steps.compare(server.endpoint, scored)
        server.stop()
    laps.end("restart")
    size = steps.pack(scored, out / "map.triquad")
    laps.end("pack")
    steps.draw(scored.surface, [out / "street.glb", out / "street.ply"], out / "street.png")
    laps.end("draw")
    cpus = os.cpu_count() or 1
    parts = (learnt.intake, learnt.queries, scored.street, scored.mesh, restart, size)
    results = DemoResults(street_seed, cpus, *parts, laps.seconds)
    (out / "results.json").write_text(json_text(results) + "\n", encoding="utf-8")
    return results


class _Laps:
    """How long each phase took."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._since = time.monotonic()

    def end(self, phase: str) -> None:
        """End a phase; the next begins."""
        now = time.monotonic()
        self.seconds[phase] = now - self._since
        self._since = now


def _say(message: str) -> None:
    print(message, file=sys.stderr, flush=True)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=_COMMAND,
        description="Map a simulated street with a real server, ask it while it learns, score the "
        "map against the exact street, restart the server and ask again. Takes some minutes.",
        epilog="Exit status: 0 all is as the README promises, 1 something is not or failed, "
        "2 wrong usage.",
    )
    add = parser.add_argument
    add("--out", type=Path, default=Path("demo-out"), metavar="DIR", help="default: demo-out")
    add("--scans", type=count, default=60, metavar="N", help="a metre apart (default: 60)")
    add("--seed", type=seed, default=1, metavar="N", help="of the street (default: 1)")
    add_version(parser)
    return parser
