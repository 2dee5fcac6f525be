"""``triquad-inspect``: what maps hold, whether their files are valid, and how they differ."""

import argparse

from triquad_format.mapfile.metadata import utc_time
from triquad_format.mapfile.reader import MapFile, read_map_file
from triquad_format.wire.keys import DEFAULT_MAP

from triquad_tools.commands.inspect import COMMAND
from triquad_tools.console.command import FAILED, OK, ToolError, complain, print_line, refuse
from triquad_tools.console.progress import progress
from triquad_tools.console.report import json_text
from triquad_tools.mapfiles.checkpoint_history import print_log, read_log
from triquad_tools.mapfiles.diff import (
    compare,
    difference,
    object_changes,
    print_diff,
    print_objects,
)
from triquad_tools.mapfiles.source import SourceMap, is_endpoint, map_file
from triquad_tools.mapfiles.summary import print_summary, summarise


def work(options: argparse.Namespace) -> int:
    """Tell what a file, a folder or a server holds, or how two maps differ."""
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
    tell = _log if options.log else _diff if options.diff else _show
    return tell(options)


def _show(options: argparse.Namespace) -> int:
    name, file = _read(options, str(options.files[0]))
    summary = summarise(file)
    if options.plot:
        from triquad_tools.mapping.output import export  # slow to import

        export(SourceMap(file.record, file.manifest.stamp_ns), options.plot)
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
        return complain(COMMAND, message, FAILED)
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
