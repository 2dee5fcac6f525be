"""``triquad-bench``: how fast and how good triquad is on this machine."""

import argparse
import datetime
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from triquad_tools.console.arguments import add_version, count, positive, seed
from triquad_tools.console.command import (
    BAD_INPUT,
    OK,
    ToolError,
    complain,
    run,
)
from triquad_tools.console.interrupts import sigterm_interrupts
from triquad_tools.console.progress import progress
from triquad_tools.console.report import Row, json_text, print_rows

if TYPE_CHECKING:
    from triquad_tools.benchmarks.figures import Figure
    from triquad_tools.benchmarks.street import BenchStreet

    _Measures = dict[str, Callable[[], list[Figure]]]

_COMMAND = "triquad-bench"
_USUAL_ON_STREET = (
    "core",
    "server",
    "file",
    "store",
    "mesh",
    "fill",
    "answers",
    "align",
    "offline",
    "metrics",
    "security",
    "neighbours",
    "borders",
)
_ON_STREET = (*_USUAL_ON_STREET, "tradeoffs", "viewer")
USUAL_PARTS = (
    *_USUAL_ON_STREET,
    "start",
    "growth",
    "restart",
    "far-scan",
    "parked",
    "air",
    "moving",
    "sweeps",
    "ros2",
    "presets",
)
PARTS = (*USUAL_PARTS, "tradeoffs", "viewer", "ablation", "long-drive")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool: 0 done, whatever the figures; 1 a part failed; 2 wrong usage or input."""
    options = _parser().parse_args(argv)
    if options.drawn_from is not None and (options.plot is None or options.parts):
        message = "--from draws what is in a file: give --plot OUT.png and no parts"
        return complain(_COMMAND, message, BAD_INPUT)
    if options.plot is not None and options.plot.suffix.lower() != ".png":
        return complain(_COMMAND, f"{options.plot}: its name must end in .png", BAD_INPUT)
    for path in (options.json, options.record, options.plot):
        if path is not None and not os.access(path.parent, os.W_OK):
            message = f"{path}: cannot be written: choose another folder"
            return complain(_COMMAND, message, BAD_INPUT)
    with sigterm_interrupts():
        if options.drawn_from is not None:
            return run(_COMMAND, partial(_draw_saved, options))
        return run(_COMMAND, partial(_bench, options), failures=(ToolError, OSError))


def _bench(options: argparse.Namespace) -> int:
    """Measure part after part; what is known of one is told and kept before the next begins."""
    wanted = options.parts or (("tradeoffs",) if options.plot is not None else USUAL_PARTS)
    if options.plot is not None and "tradeoffs" not in wanted:
        wanted = (*wanted, "tradeoffs")
    on_street = [part for part in _ON_STREET if part in wanted]
    alone = [part for part in PARTS if part in wanted and part not in _ON_STREET]
    _compile()
    measured: dict[str, list[Figure]] = {}
    for measures_of, parts in ((_on_street, on_street), (_alone, alone)):
        for part, measure in measures_of(parts, options).items():
            measured[part] = measure()
            _present(part, measured, options)
    return OK


def _compile() -> None:
    """Have all kernels compiled, so that no part but "start" meets a first start."""
    from triquad_server.settings import Settings  # slow to import
    from triquad_server.warm_up import warm_up

    with progress("compiling") as report:
        warm_up(Settings(), "cpu", report=lambda stage: report(0.0, stage))


def _draw_saved(options: argparse.Namespace) -> int:
    from triquad_tools.benchmarks.tradeoff_sheet import draw_tradeoffs, saved_tradeoffs

    draw_tradeoffs(saved_tradeoffs(options.drawn_from), options.plot)
    return OK


def _on_street(parts: Sequence[str], options: argparse.Namespace) -> "_Measures":
    """What measures parts on one drive."""
    if not parts:
        return {}
    from triquad_tools.benchmarks.align import measure_align  # slow to import
    from triquad_tools.benchmarks.borders import measure_borders
    from triquad_tools.benchmarks.core import measure_core
    from triquad_tools.benchmarks.file import measure_file, measure_offline
    from triquad_tools.benchmarks.fill import measure_fill
    from triquad_tools.benchmarks.mesh import measure_mesh
    from triquad_tools.benchmarks.neighbours import measure_neighbours
    from triquad_tools.benchmarks.planners import measure_planners
    from triquad_tools.benchmarks.scraping import measure_scraping
    from triquad_tools.benchmarks.security import measure_security
    from triquad_tools.benchmarks.server import measure_server
    from triquad_tools.benchmarks.store import measure_store
    from triquad_tools.benchmarks.street import bench_street
    from triquad_tools.benchmarks.tradeoffs import measure_tradeoffs

    measures: dict[str, Callable[[BenchStreet], list[Figure]]] = {
        "core": measure_core,
        "server": measure_server,
        "file": measure_file,
        "store": measure_store,
        "mesh": measure_mesh,
        "fill": measure_fill,
        "answers": measure_planners,
        "align": partial(measure_align, folder=options.recorded),
        "offline": measure_offline,
        "tradeoffs": measure_tradeoffs,
        "metrics": measure_scraping,
        "security": measure_security,
        "neighbours": measure_neighbours,
        "borders": measure_borders,
        "viewer": _viewer,
    }
    made = bench_street(options.seed)
    return {part: partial(measures[part], made) for part in parts}


def _viewer(made: "BenchStreet") -> "list[Figure]":
    """Measured where playwright is installed, and Chromium."""
    try:
        from triquad_tools.benchmarks.viewer import measure_viewer
    except ModuleNotFoundError as error:
        if error.name != "playwright":
            raise
        raise ToolError("playwright is missing: install triquad[browser]") from error
    return measure_viewer(made)


def _alone(parts: Sequence[str], options: argparse.Namespace) -> "_Measures":
    """What measures parts that each drive for themselves."""
    if not parts:
        return {}
    from triquad_tools.benchmarks.ablation import measure_ablation  # slow to import
    from triquad_tools.benchmarks.air import measure_air
    from triquad_tools.benchmarks.far_scan import measure_far_scan
    from triquad_tools.benchmarks.long_drive import measure_long_drive
    from triquad_tools.benchmarks.moving import measure_moving
    from triquad_tools.benchmarks.parked import measure_parked
    from triquad_tools.benchmarks.presets import measure_presets
    from triquad_tools.benchmarks.restart import measure_restart
    from triquad_tools.benchmarks.ros2 import measure_ros2
    from triquad_tools.benchmarks.start import measure_start
    from triquad_tools.benchmarks.sweeps import measure_sweeps

    measures: dict[str, Callable[[int], list[Figure]]] = {
        "start": lambda _: measure_start(),
        "growth": _growth,
        "restart": measure_restart,
        "far-scan": measure_far_scan,
        "parked": measure_parked,
        "air": measure_air,
        "moving": partial(measure_moving, folder=options.recorded),
        "sweeps": measure_sweeps,
        "ros2": measure_ros2,
        "presets": measure_presets,
        "long-drive": measure_long_drive,
        "ablation": partial(measure_ablation, scans=options.scans, step_m=options.step),
    }
    return {part: partial(measures[part], options.seed) for part in parts}


def _growth(street_seed: int) -> "list[Figure]":
    """Measured in a process of its own, whose memory nothing else has used."""
    from triquad_tools.benchmarks.figures import Figure

    command = [sys.executable, "-m", "triquad_tools.benchmarks.growth", str(street_seed)]
    result = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if result.returncode != 0:
        raise ToolError(f"the part growth ended with exit code {result.returncode}")
    return [Figure(**entry) for entry in json.loads(result.stdout)]


def machine() -> str:
    """The machine in words."""
    cpuinfo = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*: (.*)", cpuinfo.read_text()) if cpuinfo.exists() else None
    name = found[1] if found else platform.processor() or platform.machine()
    return f"{name}, {os.cpu_count()} cores, Python {platform.python_version()}"


def _present(part: str, measured: "dict[str, list[Figure]]", options: argparse.Namespace) -> None:
    """Tell the figures of a part, and keep those of all parts so far."""
    from triquad_tools.benchmarks.figures import markdown

    figures = measured[part]
    title = f"{datetime.date.today().isoformat()}, {machine()}, street {options.seed}"
    rows = [Row(figure.name, figure.shown, _note(figure)) for figure in figures]
    print_rows(f"{title}, part {part}", rows)
    if options.json is not None:
        shown = [{"part": of} | asdict(one) for of in measured for one in measured[of]]
        result = {"title": title, "street": options.seed, "figures": shown}
        options.json.write_text(json_text(result) + "\n", encoding="utf-8")
    if options.record is not None:
        with options.record.open("a", encoding="utf-8") as page:
            page.write("\n" + markdown(f"{title}, part {part}", figures))
    if options.plot is not None and part == "tradeoffs":
        from triquad_tools.benchmarks.tradeoff_sheet import Tradeoffs, draw_tradeoffs

        draw_tradeoffs(Tradeoffs(title, options.seed, figures), options.plot)


def _note(figure: "Figure") -> str:
    if not figure.wanted:
        return ""
    return f"{figure.wanted}: {'yes' if figure.kept else 'NO'}"


def _part(name: str) -> str:
    if name not in PARTS:
        raise argparse.ArgumentTypeError(f"{name!r} is none of {', '.join(PARTS)}")
    return name


_DESCRIPTION = (
    "Measure triquad on this machine, on a simulated street: a server under a 10 Hz lidar, its "
    "core against eager torch, a start where nothing was ever compiled, a map that grows to 16 "
    "regions, one that is restored, the map file, checkpoints, mesh tiles, filled holes, answers "
    "to planners, scans put back, maps opened offline, a server whose metrics are read, one with "
    "roles, clients that want too much, a street across borders of regions, a scan far away, open "
    "air, things that move, a lidar that moves while it turns, clouds of ROS 2, rooms, tables and "
    "streets with the presets that are for them, and, if asked for, the viewer in a browser, the "
    "ablation and 1.6 km of street. Takes more than an hour; nothing else should run meanwhile."
)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=_COMMAND,
        description=_DESCRIPTION,
        epilog="Exit status: 0 done, whatever the figures, 1 a part failed, 2 wrong usage or "
        "a FILE that cannot be used.",
    )
    add = parser.add_argument
    add(
        "parts",
        nargs="*",
        type=_part,
        metavar="PART",
        help=f"of {', '.join(PARTS)} (default: all but tradeoffs, viewer, ablation and long-drive)",
    )
    add(
        "--seed",
        type=seed,
        default=1,
        metavar="N",
        help="of the street, room or table (default: 1)",
    )
    add(
        "--recorded",
        type=Path,
        metavar="FOLDER",
        help="KITTI-style scans to align, and to map twice over, too",
    )
    add("--scans", type=count, default=60, metavar="N", help="of the ablation (default: 60)")
    add("--step", type=positive, default=1.0, metavar="M", help="between them (default: 1)")
    _add_outputs(add)
    add_version(parser)
    return parser


def _add_outputs(add: Callable[..., argparse.Action]) -> None:
    add(
        "--plot",
        type=Path,
        metavar="OUT.png",
        help="draw accuracy by time, by bytes and by scan spacing: the part tradeoffs, which takes "
        "a few minutes; without PART nothing else is measured",
    )
    add(
        "--from",
        dest="drawn_from",
        type=Path,
        metavar="FILE",
        help="draw what --json FILE saved of it, and measure nothing",
    )
    add("--json", type=Path, metavar="FILE", help="write the figures there, too")
    add("--record", type=Path, metavar="FILE.md", help="add a table to this page")
