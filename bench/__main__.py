"""``make bench``: how fast and how good triquad is on this machine, part by part.

Each part checks a promise of the README. Its figures are kept in ``bench/results``, and
``docs/benchmarks.md`` is made of all that lie there.
"""

import argparse
import datetime
import sys
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path

from triquad_server.settings import Settings
from triquad_server.warm_up import warm_up
from triquad_tools.console.arguments import seed
from triquad_tools.console.command import run
from triquad_tools.console.progress import progress
from triquad_tools.console.report import Row, print_rows

from bench.figures import Figure
from bench.parts.answers import measure_planners
from bench.parts.belief import measure_belief
from bench.parts.core import measure_core
from bench.parts.file import measure_file
from bench.parts.neighbours import measure_neighbours
from bench.parts.parked import measure_parked
from bench.parts.presets import measure_presets
from bench.parts.revisited import measure_revisited
from bench.parts.server import measure_server
from bench.parts.start import measure_start
from bench.parts.store import measure_store
from bench.results import RESULTS, Result, machine, write_page
from bench.street import bench_street
from bench.street_scores import DrivenStreet

_Measure = Callable[[argparse.Namespace], list[Figure]]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmarks: 0 done, whatever the figures; 1 or 2 a part failed, or wrong usage."""
    options = _parser().parse_args(argv)
    return run("bench", partial(_bench, options))


def _bench(options: argparse.Namespace) -> int:
    """Measure the parts in turn; the figures of each are saved before the next begins."""
    _compile(options.device)
    for part in options.parts or PARTS:
        figures = PARTS[part](options)
        today, where = datetime.date.today().isoformat(), machine(options.device)
        earlier = Result.read(options.results, part)
        remark = "" if earlier is None else earlier.remark
        result = Result(part, today, where, options.seed, figures=figures, remark=remark)
        print_rows(result.title, [Row(one.name, one.shown, one.verdict) for one in figures])
        result.write(options.results)
    write_page(options.results)
    return 0


def _compile(device: str) -> None:
    """Compile all kernels, so that no part but "start" meets a first start."""
    with progress("compiling") as report:
        warm_up(Settings(), device, report=lambda stage: report(0.0, stage))


@cache
def _street(number: int) -> DrivenStreet:
    return bench_street(number)


def _viewer(options: argparse.Namespace) -> list[Figure]:
    from bench.parts.viewer import measure_viewer  # needs a browser

    return measure_viewer(_street(options.seed))


PARTS: dict[str, _Measure] = {
    "core": lambda options: measure_core(_street(options.seed), options.device),
    "server": lambda options: [
        *measure_server(_street(options.seed)),
        *measure_neighbours(_street(options.seed)),
    ],
    "answers": lambda options: measure_planners(_street(options.seed)),
    "file": lambda options: [
        *measure_file(_street(options.seed)),
        *measure_store(_street(options.seed)),
    ],
    "moving": lambda options: [
        *measure_revisited(options.recorded),
        *measure_belief(held=False),
        *measure_belief(held=True),
        *measure_parked(options.seed),
    ],
    "presets": lambda options: measure_presets(options.seed),
    "start": lambda _: measure_start(),
    "viewer": _viewer,
}


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
    recorded = "a folder of scans that part moving maps twice over, too"
    add("--recorded", type=Path, metavar="FOLDER", help=recorded)
    kept = "where figures are kept (default: bench/results)"
    add("--results", type=Path, default=RESULTS, metavar="FOLDER", help=kept)
    return parser


if __name__ == "__main__":
    sys.exit(main())
