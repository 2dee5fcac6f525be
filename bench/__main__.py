"""``make bench``: how fast and how good triquad is on this machine, part by part.

Each part checks a promise of the README. Its figures are kept in ``bench/results``, and
``docs/benchmarks.md`` is made of all that lie there.
"""

import argparse
import datetime
import importlib
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from triquad_server.settings import Settings
from triquad_server.warm_up import warm_up
from triquad_tools.console.arguments import seed
from triquad_tools.console.command import run
from triquad_tools.console.progress import progress
from triquad_tools.console.report import Row, print_rows

from bench.results_page import RESULTS, Result, machine, write_page

PARTS = (
    "core",
    "server",
    "answers",
    "file",
    "moving",
    "poses",
    "city",
    "maps",
    "shared",
    "batch",
    "merge",
    "presets",
    "start",
    "viewer",
)
"""The modules of ``bench.parts`` that measure, each imported in its turn: one needs a browser."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmarks: 0 done, whatever the figures; 1 or 2 a part failed, or wrong usage."""
    options = _parser().parse_args(argv)
    return run("bench", partial(_bench, options))


def _bench(options: argparse.Namespace) -> int:
    """Measure the parts in turn; the figures of each are saved before the next begins."""
    # All kernels, so that no part but "start" meets a first start.
    with progress("compiling") as report:
        warm_up(Settings(), options.device, report=lambda stage: report(0.0, stage))
    for part in options.parts or PARTS:
        figures = importlib.import_module(f"bench.parts.{part}").measure(options)
        today, where = datetime.date.today().isoformat(), machine(options.device)
        earlier = Result.read(options.results, part)
        remark = "" if earlier is None else earlier.remark
        result = Result(part, today, where, options.seed, figures=figures, remark=remark)
        print_rows(result.title, [Row(one.name, one.shown, one.verdict) for one in figures])
        result.write(options.results)
    write_page(options.results)
    return 0


def _part(name: str) -> str:
    if name not in PARTS:
        raise argparse.ArgumentTypeError(f"{name!r} is none of {', '.join(PARTS)}")
    return name


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="bench",
        description=f"Measure triquad on this machine: {', '.join(PARTS)}. All of it takes more "
        "than an hour; nothing else should run meanwhile.",
        epilog="Exit status: 0 done, whatever the figures, 1 a part failed, 2 wrong usage or input",
    )
    add = parser.add_argument
    add("parts", nargs="*", type=_part, metavar="PART", help="(default: all)")
    seeds = "of streets, rooms and tables (default: 2)"
    add("--seed", type=seed, default=2, metavar="N", help=seeds)
    trains = "what part core trains on (default: cpu)"
    add("--device", choices=("cpu", "cuda"), default="cpu", help=trains)
    kept = "where figures are kept (default: bench/results)"
    add("--results", type=Path, default=RESULTS, metavar="FOLDER", help=kept)
    return parser


if __name__ == "__main__":
    sys.exit(main())
