"""``triquad-map``: a recording in, a map out."""

import argparse
from collections.abc import Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

from triquad_server.errors import StoreError
from triquad_server.mapping.mapper import Mapper
from triquad_server.process.installed import DEVICES, check_device
from triquad_server.process.threads import Teams
from triquad_server.settings.loading import PRESETS, load_settings
from triquad_server.warm_up import warm_up

from triquad_tools.console.arguments import add_fill, command_parser
from triquad_tools.console.command import OK, ToolError, print_line, print_remark, run
from triquad_tools.console.progress import progress
from triquad_tools.mapping.mapping_run import MAP_NAME, MappingRun, mapping_key, read_unfinished
from triquad_tools.mapping.output import SUFFIXES, check_fill, check_target, why, write_output
from triquad_tools.recordings.opening import Selection, open_selected
from triquad_tools.recordings.recording import add_recording

_COMMAND = "triquad-map"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool: 0 done, 1 nothing could be written, 2 bad input, 130 interrupted."""
    work = partial(_map, _parser().parse_args(argv))
    interrupted = "interrupted; the same command goes on where the map was saved last"
    return run(_COMMAND, work, interrupted=interrupted)


def _map(options: argparse.Namespace) -> int:
    output = options.output
    check_target(output, force=options.force)
    check_fill(output, options.fill)
    settings = load_settings(options.settings, options.set, preset=options.preset)
    check_device(options.device)
    selection = open_selected(options)
    key, part = mapping_key(selection, settings), output.with_name(f"{output.name}.part")
    unfinished = read_unfinished(part, key)
    with closing(Teams()) as teams:
        # The first time all kernels are compiled, which takes half a minute or more.
        with progress("preparing") as report:
            warm_up(settings, options.device, teams, report=lambda stage: report(0.0, stage))
        mapper = Mapper(MAP_NAME, settings, options.device, record=unfinished.record, teams=teams)
        mapper.publish()
        taken = unfinished.scans_taken
        del unfinished  # a map need not be in memory twice
        if taken:
            print_line(f"going on after scan {taken}, from {part}")
        mapping = MappingRun(mapper, settings, part, key, taken)
        mapping.take(selection)
        _check_result(mapper, mapping, selection)
        mapping.settle()  # which saves the map, should the output not be written
        record, cell_m = mapper.changes_since(None).record, settings.mesh.cell_m
        try:
            written = write_output(
                record, output, cell_m=cell_m, training=options.training, fill_m=options.fill
            )
        except OSError as error:
            raise StoreError(
                f"{output} cannot be written: {why(error)}; the map is in {part}: the same "
                "command writes it once there is room"
            ) from error
    part.unlink()
    print_line(f"{output}: {written}")
    return OK


def _check_result(mapper: Mapper, mapping: MappingRun, selection: Selection) -> None:
    refused = sum(mapping.refusals.values())
    if refused:
        reasons = ", ".join(f"{reason}: {n}" for reason, n in mapping.refusals.items())
        told = f"{refused} of {len(selection)} scans could not be used ({reasons})"
        told += f"; the last: {mapping.last_refusal}"
        if not mapper.regions:
            raise ToolError(f"nothing was mapped: {told}")
        print_remark(f"{_COMMAND}: {told}")


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        _COMMAND,
        description="Make a map of a recording, without a server or a network.",
        epilog="Exit status: 0 done; 1 the map could not be written; 2 wrong usage, or input of "
        "which nothing can be used; 130 interrupted: the same command then goes on where it was.",
    )
    add_recording(parser)
    add = parser.add_argument
    add("output", type=Path, metavar="OUT", help="its name ends in " + ", ".join(SUFFIXES))
    add("--preset", choices=PRESETS, help="settings for a kind of place and sensor")
    add("--settings", type=Path, metavar="FILE", help="settings of the map, as of triquad-server")
    one = "one setting, such as field.leaf_m=0.05, repeatable"
    add("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help=one)
    add_fill(parser)
    add("--device", choices=DEVICES, default="cpu", help="what it trains on (default: cpu)")
    add("--training", action="store_true", help="keep what further training needs in the map file")
    add("--force", action="store_true", help="replace OUT where it exists")
    return parser
