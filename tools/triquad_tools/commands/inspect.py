"""``triquad-inspect``: what map files hold, whether they are sound, and how they differ."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from triquad_tools.console.arguments import count, positive
from triquad_tools.console.errors import ToolError
from triquad_tools.console.report import json_text

if TYPE_CHECKING:
    from triquad_format.mapfile.mapfile import MapFile

OK, DAMAGED, BAD_INPUT = 0, 1, 2

_TILE_M = 6.4
_LEAST_TILE_M = 0.1
_ROWS = 20
_PICTURE_SUFFIX = ".png"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool: 0 sound, 1 damaged, 2 not readable, or wrong usage."""
    options = _parser().parse_intermixed_args(argv)
    from triquad_format.errors import DamagedMapFileError, FormatError

    from triquad_tools.mapfiles.checks import FailedCheckError
    from triquad_tools.mapfiles.whole_map import MissingFilesError

    try:
        _check_usage(options)
        return _run(options)
    except (DamagedMapFileError, FailedCheckError, MissingFilesError) as error:
        return _complain(str(error), DAMAGED)
    except (FormatError, ToolError, OSError) as error:
        return _complain(str(error), BAD_INPUT)
    except KeyboardInterrupt:
        return _complain("interrupted", BAD_INPUT)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="triquad-inspect",
        description="Show what a map file holds, a folder's history, or how two maps differ. "
        "Map files are read in full and checked.",
        epilog="Exit status: 0 sound, also where maps differ; 1 damaged; 2 not readable (missing, "
        "or of a newer version), or wrong usage.",
    )
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE", help="map file")
    parser.add_argument(
        "--verify",
        action="store_true",
        help="check also with the mcap library and by evaluating the field; list the checks",
    )
    parser.add_argument(
        "--log", action="store_true", help="list the checkpoints in the folder FILE"
    )
    parser.add_argument("--diff", action="store_true", help="compare two map files, A and B")
    parser.add_argument("--plot", type=Path, metavar="OUT.png", help="draw a plan of the map(s)")
    parser.add_argument(
        "--tile", type=positive, metavar="M", help=f"side of a tile of --diff ({_TILE_M} m)"
    )
    parser.add_argument("--limit", type=count, metavar="N", help=f"rows of --diff ({_ROWS})")
    parser.add_argument("--json", action="store_true", help="print JSON")
    return parser


def _check_usage(options: argparse.Namespace) -> None:
    """Refuse what does not go together."""
    given, plot = len(options.files), options.plot
    problems = {
        "--log and --diff exclude each other": options.log and options.diff,
        f"--diff compares two map files: {given} given": options.diff and given != 2,
        f"only --diff takes more than one file: {given} given": not options.diff and given > 1,
        "--verify is for one map file": options.verify and (options.log or options.diff),
        "--tile and --limit go with --diff": (options.tile or options.limit) and not options.diff,
        f"--tile {options.tile} m is too small: use {_LEAST_TILE_M} or more": (
            options.tile and options.tile < _LEAST_TILE_M
        ),
        "--plot is for map files, not for --log": options.log and plot,
        f"--plot {plot}: its name must end in {_PICTURE_SUFFIX}": (
            plot and plot.suffix != _PICTURE_SUFFIX
        ),
        f"--plot {plot}: its folder does not exist": plot and not plot.parent.is_dir(),
        f"--plot {plot}: that is the map file itself": (
            plot and plot.exists() and any(p.exists() and plot.samefile(p) for p in options.files)
        ),
    }
    for problem, there in problems.items():
        if there:
            raise ToolError(problem)


def _run(options: argparse.Namespace) -> int:
    if options.log:
        return _log(options)
    return _diff(options) if options.diff else _show(options)


def _show(options: argparse.Namespace) -> int:
    """One map file."""
    import dataclasses

    from triquad_tools.mapfiles.checks import verify
    from triquad_tools.mapfiles.summary import print_summary, summarise
    from triquad_tools.mapfiles.whole_map import read_whole

    path = options.files[0]
    file = read_whole(path)
    summary = summarise(file)
    if options.verify:
        summary = dataclasses.replace(summary, checks=verify(path, file))
    if options.plot:
        from triquad_tools.plots.plan_view import plan_picture

        plan_picture(_title(path, file), file).save(options.plot)
    if options.json:
        print(json_text(summary))
    else:
        print_summary(str(path), summary)
    return OK


def _log(options: argparse.Namespace) -> int:
    """The checkpoints of a folder."""
    from triquad_tools.mapfiles.store_log import print_log, read_log

    path = options.files[0]
    if path.is_file():
        raise ToolError(f"{path} is a file: --log lists the checkpoints in a folder")
    log = read_log(path)
    if options.json:
        print(json_text(log))
    else:
        print_log(log)
    if log.damaged:
        return _complain(f"{log.damaged} of {len(log.checkpoints)} do not open", DAMAGED)
    return OK


def _diff(options: argparse.Namespace) -> int:
    """Two map files."""
    from triquad_tools.console.progress import progress
    from triquad_tools.mapfiles.diff import compare, difference, print_diff
    from triquad_tools.mapfiles.whole_map import read_whole

    a, b = (read_whole(path) for path in options.files)
    with progress("comparing"):
        comparison = compare(a.record, b.record)
    diff = difference(comparison, options.tile or _TILE_M)
    titles = [
        f"{letter}  {_title(path, file)}"
        for letter, path, file in zip("AB", options.files, (a, b), strict=True)
    ]
    if options.plot:
        from triquad_tools.plots.diff_view import diff_picture

        diff_picture(titles, comparison).save(options.plot)
    if options.json:
        print(json_text(diff))
    else:
        print("\n".join(titles))
        print_diff(diff, options.limit or _ROWS)
    return OK


def _title(path: Path, file: "MapFile") -> str:
    return f"{path}: map {file.record.name!r}, epoch {file.record.epoch}"


def _complain(message: str, code: int) -> int:
    print(f"triquad-inspect: {message}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
