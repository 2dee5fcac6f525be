"""``triquad-inspect``: what maps hold, whether their files are valid, how they differ, slices."""

import argparse
import dataclasses
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from triquad_format.errors import DamagedMapFileError
from triquad_format.mapfile.metadata import utc_time
from triquad_format.mapfile.reader import MapFile

from triquad_tools.console.arguments import add_version, count, positive
from triquad_tools.console.command import FAILED, OK, ToolError, complain, refuse, run
from triquad_tools.console.lines import print_line
from triquad_tools.console.progress import progress
from triquad_tools.console.report import json_text
from triquad_tools.console.server_arguments import DEFAULT_MAP, add_config
from triquad_tools.mapfiles.checks import FailedCheckError, verify
from triquad_tools.mapfiles.diff import compare, difference, print_diff
from triquad_tools.mapfiles.object_changes import object_changes, print_objects
from triquad_tools.mapfiles.source import (
    Access,
    chosen_file,
    is_endpoint,
    map_file,
    read_whole,
)
from triquad_tools.mapfiles.store_log import print_log, read_log
from triquad_tools.mapfiles.summary import print_summary, summarise

_COMMAND = "triquad-inspect"
_DAMAGE = (DamagedMapFileError, FailedCheckError)
_TILE_M = 6.4
_LEAST_TILE_M = 0.1
_ROWS = 20
_CELL_M = 0.1
_PICTURE_SUFFIX = ".png"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool: 0 valid, 1 damaged, 2 not readable, or wrong usage."""
    options = _parser().parse_intermixed_args(argv)
    return run(_COMMAND, partial(_inspect, options), failures=_DAMAGE)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=_COMMAND,
        description="Show what a map file holds, a folder's history, how two maps differ, or a "
        "slice of a map. Map files are read in full and checked.",
        epilog="Exit status: 0 valid, also where maps differ; 1 damaged, or the server failed; "
        "2 not readable (missing, or of a newer version), or wrong usage.",
    )
    add = parser.add_argument
    add(
        "files",
        type=Path,
        nargs="+",
        metavar="FILE",
        help="map file; folder of checkpoints, of which the newest is meant; or endpoint of a "
        "server, such as tcp/127.0.0.1:7447, whose map is fetched",
    )
    add("--map", metavar="NAME", help="of the server (default: default)")
    add_config(parser)
    add(
        "--at",
        metavar="EPOCH_OR_TIME",
        help="the newest checkpoint of the folder FILE that is not after this, such as 120 or "
        "2026-01-31T12:00:00Z",
    )
    add(
        "--verify",
        action="store_true",
        help="check also with the mcap library and by evaluating the field; list the checks",
    )
    add("--log", action="store_true", help="list the checkpoints in the folder FILE")
    add("--diff", action="store_true", help="compare two map files, A and B")
    add("--plot", type=Path, metavar="OUT.png", help="draw a plan of the map(s), or the slice")
    add("--tile", type=positive, metavar="M", help=f"side of a tile of --diff ({_TILE_M} m)")
    add("--limit", type=count, metavar="N", help=f"rows of each table of --diff ({_ROWS})")
    add("--json", action="store_true", help="print JSON")
    _add_slice(parser.add_argument_group("slices"))
    add_version(parser)
    return parser


def _add_slice(group: argparse._ArgumentGroup) -> None:
    add = group.add_argument
    add(
        "--slice",
        type=float,
        metavar="Z",
        help="draw distance and status at this height, metres, into --plot",
    )
    add(
        "--box",
        type=float,
        nargs=4,
        metavar=("WEST", "SOUTH", "EAST", "NORTH"),
        help="what it shows, metres, map frame (default: all that a file has seen)",
    )
    add("--cell", type=positive, metavar="M", help=f"side of its cells (default: {_CELL_M:g})")


def _check_usage(options: argparse.Namespace) -> None:
    """Refuse what does not go together."""
    given, plot, sliced = len(options.files), options.plot, options.slice is not None
    other = options.log or options.diff or options.verify or options.json
    problems = {
        "--log and --diff exclude each other": options.log and options.diff,
        f"--diff compares two map files: {given} given": options.diff and given != 2,
        f"only --diff takes more than one file: {given} given": not options.diff and given > 1,
        "--verify is for one map file": options.verify and (options.log or options.diff),
        "--tile and --limit go with --diff": (options.tile or options.limit) and not options.diff,
        f"--tile {options.tile} m is too small: use {_LEAST_TILE_M} or more": (
            options.tile and options.tile < _LEAST_TILE_M
        ),
        "--at is for one map, not for --log or --diff": options.at
        and (options.log or options.diff),
        "--slice needs --plot OUT.png": sliced and not plot,
        "--slice excludes --log, --diff, --verify and --json": sliced and other,
        "--box and --cell go with --slice": (options.box or options.cell) and not sliced,
        "--map and --config are of a server, and none is given": (
            (options.map or options.config)
            and not any(is_endpoint(str(path)) for path in options.files)
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
    refuse(problems)


def _inspect(options: argparse.Namespace) -> int:
    _check_usage(options)
    if options.slice is not None:
        return _slice(options)
    if options.log:
        return _log(options)
    return _diff(options) if options.diff else _show(options)


def _access(options: argparse.Namespace) -> Access:
    return Access(options.map or DEFAULT_MAP, options.config)


def _show(options: argparse.Namespace) -> int:
    """Print one map."""
    target = str(options.files[0])
    with map_file(target, _access(options), options.at) as path:
        name = target if is_endpoint(target) else str(path)
        file = read_whole(path)
        summary = summarise(file)
        if options.verify:
            summary = dataclasses.replace(summary, checks=verify(file))
    if options.plot:
        from triquad_tools.plots.map_plan import draw_map  # slow to import

        draw_map(_title(name, file), file.record, options.plot)
    if options.json:
        print_line(json_text(summary))
    else:
        print_summary(name, summary)
    return OK


def _slice(options: argparse.Namespace) -> int:
    """Print one layer of a map, of a file or of a server."""
    from triquad_tools.plots.slice_plan import SliceOptions, draw_slice  # slow to import

    wanted = SliceOptions(options.slice, options.box, options.cell or _CELL_M)
    target = str(options.files[0])
    if not is_endpoint(target):
        target = str(chosen_file(Path(target), options.at))
    draw_slice(target, _access(options), wanted, path=options.plot)
    return OK


def _log(options: argparse.Namespace) -> int:
    """Print the checkpoints of a folder."""
    path = options.files[0]
    if path.is_file():
        raise ToolError(f"{path} is a file: --log lists the checkpoints in a folder")
    log = read_log(path)
    if options.json:
        print_line(json_text(log))
    else:
        print_log(log)
    if log.damaged:
        message = f"{log.damaged} of {len(log.checkpoints)} do not open"
        return complain(_COMMAND, message, FAILED)
    return OK


def _diff(options: argparse.Namespace) -> int:
    """Compare two map files."""
    from triquad_client import OfflineMap  # slow to import

    files, titles = [], []
    for letter, target in zip("AB", map(str, options.files), strict=True):
        with map_file(target, _access(options)) as path:
            files.append(read_whole(path))
            name = target if is_endpoint(target) else str(path)
        titles.append(f"{letter}  {_title(name, files[-1])}")
    a, b = files
    with progress("comparing"), OfflineMap(a.record) as old, OfflineMap(b.record) as new:
        comparison = compare(old, new)
    diff = difference(comparison, options.tile or _TILE_M)
    objects = object_changes(comparison)
    if options.plot:
        from triquad_tools.plots.diff_plan import draw_diff  # slow to import

        draw_diff("\n".join(titles), comparison, objects, path=options.plot)
    if options.json:
        print_line(json_text({**vars(diff), "objects": objects}))
    else:
        print_line("\n".join(titles))
        print_diff(diff, options.limit or _ROWS)
        print_objects(objects, options.limit or _ROWS)
    return OK


def _title(name: str, file: MapFile) -> str:
    stamp_ns = file.manifest.stamp_ns
    when = f", {utc_time(stamp_ns)}" if stamp_ns else ""
    return f"{name}: map {file.record.name!r}, epoch {file.record.epoch}{when}"
