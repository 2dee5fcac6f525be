"""``triquad-inspect``: what maps hold, whether their files are valid, and how they differ."""

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from triquad_format.mapfile.metadata import utc_time
from triquad_format.mapfile.reader import MapFile, read_map_file

from triquad_tools.console.arguments import DEFAULT_MAP, add_config, command_parser, picture
from triquad_tools.console.command import FAILED, OK, ToolError, complain, print_line, refuse, run
from triquad_tools.console.progress import progress
from triquad_tools.console.report import json_text
from triquad_tools.mapfiles.diff import compare, difference, print_diff
from triquad_tools.mapfiles.object_changes import object_changes, print_objects
from triquad_tools.mapfiles.source import SourceMap, is_endpoint, map_file
from triquad_tools.mapfiles.store_log import print_log, read_log
from triquad_tools.mapfiles.summary import print_summary, summarise

_COMMAND = "triquad-inspect"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool: 0 valid, 1 damaged, 2 not readable, or wrong usage."""
    options = _parser().parse_intermixed_args(argv)
    return run(_COMMAND, partial(_inspect, options))


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        _COMMAND,
        description="Show what a map file holds, a folder's history, or how two maps differ. Map "
        "files are read in full and checked.",
        epilog="Exit status: 0 valid, also where maps differ; 1 damaged, or the server failed; "
        "2 not readable (missing, or of a newer version), or wrong usage.",
    )
    add = parser.add_argument
    maps = "map file; folder of checkpoints, of which the newest is meant; or endpoint of a "
    maps += "server, such as tcp/127.0.0.1:7447, whose map is fetched"
    add("files", type=Path, nargs="+", metavar="FILE", help=maps)
    add("--map", metavar="NAME", help="of the server (default: default)")
    add_config(parser)
    at = "the newest checkpoint of the folder FILE that is not after this, such as 120 or "
    add("--at", metavar="EPOCH_OR_TIME", help=at + "2026-01-31T12:00:00Z")
    add("--log", action="store_true", help="list the checkpoints in the folder FILE")
    add("--diff", action="store_true", help="compare two map files, A and B")
    plot = "draw a picture of the map, or plans of the difference"
    add("--plot", type=picture, metavar="OUT.png", help=plot)
    add("--json", action="store_true", help="print JSON")
    return parser


def _inspect(options: argparse.Namespace) -> int:
    given, servers = len(options.files), [one for one in options.files if is_endpoint(str(one))]
    is_special, of_server = options.log or options.diff, options.map or options.config
    problems = {  # what does not go together
        "--log and --diff exclude each other": options.log and options.diff,
        f"--diff compares two map files: {given} given": options.diff and given != 2,
        f"only --diff takes more than one file: {given} given": not options.diff and given > 1,
        "--at is for one map, not for --log or --diff": options.at and is_special,
        "--map and --config are of a server, and none is given": of_server and not servers,
        "--plot is for map files, not for --log": options.log and options.plot,
    }
    refuse(problems)
    work = _log if options.log else _diff if options.diff else _show
    return work(options)


def _show(options: argparse.Namespace) -> int:
    name, file = _read(options, str(options.files[0]))
    summary = summarise(file)
    if options.plot:
        from triquad_tools.mapping.output import export  # slow to import

        export(SourceMap(file.record, file.manifest.stamp_ns or None), options.plot)
    if options.json:
        print_line(json_text(summary))
    else:
        print_summary(name, summary)
    return OK


def _log(options: argparse.Namespace) -> int:
    path = options.files[0]
    if path.is_file():
        raise ToolError(f"{path} is a file: --log lists the checkpoints in a folder")
    log = read_log(path)
    if options.json:
        print_line(json_text(log))
    else:
        print_log(log)
    if damaged := sum(one.problem is not None for one in log.checkpoints):
        message = f"{damaged} of {len(log.checkpoints)} do not open"
        return complain(_COMMAND, message, FAILED)
    return OK


def _diff(options: argparse.Namespace) -> int:
    from triquad_client import OfflineMap  # slow to import

    (name_a, a), (name_b, b) = (_read(options, str(path)) for path in options.files)
    titles = f"A  {_title(name_a, a)}\nB  {_title(name_b, b)}"
    with progress("comparing"), OfflineMap(a.record) as old, OfflineMap(b.record) as new:
        comparison = compare(old, new)
    total, objects = difference(comparison), object_changes(comparison)
    if options.plot:
        from triquad_tools.plots.diff_plan import draw_diff  # slow to import

        draw_diff(titles, comparison, objects, path=options.plot)
    if options.json:
        print_line(json_text({"total": total, "objects": objects}))
    else:
        print_line(titles)
        print_diff(total)
        print_objects(objects)
    return OK


def _read(options: argparse.Namespace, target: str) -> tuple[str, MapFile]:
    """Return the map of a file, a folder or a server, and what it is called."""
    map_name = options.map or DEFAULT_MAP
    with map_file(target, map_name, options.config, when=options.at) as path:
        return target if is_endpoint(target) else str(path), read_map_file(path)


def _title(name: str, file: MapFile) -> str:
    stamp_ns = file.manifest.stamp_ns
    when = f", {utc_time(stamp_ns)}" if stamp_ns else ""
    return f"{name}: map {file.record.name!r}, epoch {file.record.epoch}{when}"
