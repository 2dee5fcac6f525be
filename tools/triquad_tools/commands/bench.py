"""``triquad-bench``: how fast and how good triquad is on this machine."""

import argparse
import datetime
import json
import os
import platform
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from triquad_tools.console.arguments import seed
from triquad_tools.console.errors import ToolError
from triquad_tools.console.interruption import sigterm_interrupts

if TYPE_CHECKING:
    from triquad_tools.benchmarks.figures import Figure

OK, FAILED, BAD_INPUT = 0, 1, 2

PARTS = ("core", "server", "growth", "file", "store", "mesh", "answers", "align", "twin")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool: 0 done, whatever the figures; 1 a part failed; 2 wrong usage."""
    options = _parser().parse_args(argv)
    for path in (options.json, options.record):
        if path is not None and not os.access(path.parent, os.W_OK):
            return _complain(f"{path}: cannot be written: choose another folder", BAD_INPUT)
    from triquad_client import TriquadError

    try:
        with sigterm_interrupts():
            figures = measure(options.parts or list(PARTS), options.seed, options.recorded)
        _present(figures, options)
    except (ToolError, TriquadError, OSError) as error:
        return _complain(str(error), FAILED)
    except KeyboardInterrupt:
        return _complain("interrupted", FAILED)
    return OK


def measure(parts: Sequence[str], street_seed: int, recorded: Path | None = None) -> "list[Figure]":
    """The figures of some parts on one street, and of ``align`` on a recorded folder, too."""
    from triquad_tools.benchmarks.align import measure_align
    from triquad_tools.benchmarks.core import measure_core
    from triquad_tools.benchmarks.file import measure_file
    from triquad_tools.benchmarks.mesh import measure_mesh
    from triquad_tools.benchmarks.offline import measure_twin
    from triquad_tools.benchmarks.planners import measure_planners
    from triquad_tools.benchmarks.server import measure_server
    from triquad_tools.benchmarks.store import measure_store
    from triquad_tools.benchmarks.street import bench_street

    figures: list[Figure] = []
    if set(parts) - {"growth"}:
        made = bench_street(street_seed)
        if "server" in parts:
            figures += measure_server(made)
        if "core" in parts:
            figures += measure_core(made)
        if "file" in parts:
            figures += measure_file(made)
        if "store" in parts:
            figures += measure_store(made)
        if "mesh" in parts:
            figures += measure_mesh(made)
        if "answers" in parts:
            figures += measure_planners(made)
        if "align" in parts:
            figures += measure_align(made, recorded)
        if "twin" in parts:
            figures += measure_twin(made)
    if "growth" in parts:
        figures += _growth(street_seed)
    return figures


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
    name = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                name = line.partition(":")[2].strip()
                break
    return f"{name}, {os.cpu_count()} cores, Python {platform.python_version()}"


def _present(figures: "list[Figure]", options: argparse.Namespace) -> None:
    from triquad_tools.benchmarks.figures import markdown
    from triquad_tools.console.report import Row, json_text, print_table

    title = f"{datetime.date.today().isoformat()}, {machine()}, street {options.seed}"
    rows = [Row(figure.name, figure.shown, _note(figure)) for figure in figures]
    print_table(title, rows)
    if options.json is not None:
        result = {"title": title, "figures": [asdict(figure) for figure in figures]}
        options.json.write_text(json_text(result) + "\n", encoding="utf-8")
    if options.record is not None:
        with options.record.open("a", encoding="utf-8") as page:
            page.write("\n" + markdown(title, figures))


def _note(figure: "Figure") -> str:
    if not figure.wanted:
        return ""
    return f"{figure.wanted}: {'yes' if figure.kept else 'NO'}"


def _complain(message: str, code: int) -> int:
    print(f"triquad-bench: {message}", file=sys.stderr)
    return code


def _part(name: str) -> str:
    if name not in PARTS:
        raise argparse.ArgumentTypeError(f"{name!r} is none of {', '.join(PARTS)}")
    return name


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="triquad-bench",
        description="Measure triquad on this machine, on a simulated street: a server under a "
        "10 Hz lidar, its core against eager torch, a map that grows to 16 regions, the map "
        "file, checkpoints, mesh tiles, answers to planners, and scans put back in place. Takes "
        "a quarter of an hour; nothing else should run meanwhile.",
        epilog="Exit status: 0 done, whatever the figures, 1 a part failed, 2 wrong usage.",
    )
    add = parser.add_argument
    add(
        "parts", nargs="*", type=_part, metavar="PART", help=f"of {', '.join(PARTS)} (default: all)"
    )
    add("--seed", type=seed, default=1, metavar="N", help="of the street (default: 1)")
    add("--recorded", type=Path, metavar="FOLDER", help="KITTI-style scans to align, too")
    add("--json", type=Path, metavar="FILE", help="write the figures there, too")
    add("--record", type=Path, metavar="FILE.md", help="add a table to this page")
    return parser


if __name__ == "__main__":
    sys.exit(main())
