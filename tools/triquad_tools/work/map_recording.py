"""``triquad-map``: a recording in, a map out."""

import argparse
from contextlib import closing

from triquad_server.errors import StoreError
from triquad_server.mapping.mapper import Mapper
from triquad_server.process.installed import check_device
from triquad_server.process.threads import Teams
from triquad_server.settings.loading import load_settings
from triquad_server.warm_up import warm_up

from triquad_tools.commands.map_recording import COMMAND
from triquad_tools.console.command import OK, ToolError, print_line, print_remark
from triquad_tools.console.progress import progress
from triquad_tools.mapping.mapping_run import MAP_NAME, MappingRun, mapping_key, read_unfinished
from triquad_tools.mapping.output import check_fill, check_target, why, write_output
from triquad_tools.recordings.opening import Selection, open_selected


def work(options: argparse.Namespace) -> int:
    """Make a map, or go on with one that was interrupted."""
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
        mapping.settle(options.train_for)  # which saves the map, should the output not be written
        record, cell_m = mapper.snapshot_since(None).record(), settings.mesh.cell_m
        try:
            training = options.training or not mapper.settled
            written = write_output(
                record, output, cell_m=cell_m, training=training, fill_m=options.fill
            )
        except OSError as error:
            raise StoreError(
                f"{output} cannot be written: {why(error)}; the map is in {part}: the same "
                "command writes it once there is room"
            ) from error
    print_line(f"{output}: {written}")
    if mapper.settled:
        part.unlink()
        return OK
    print_line(
        f"it has had {record.learnt_percent} % of its training, and triquad-inspect tells how well "
        f"it fits; the same command without --train-for and with --force goes on, from {part}"
    )
    return OK


def _check_result(mapper: Mapper, mapping: MappingRun, selection: Selection) -> None:
    refused = sum(mapping.refusals.values())
    if refused:
        reasons = ", ".join(f"{reason}: {n}" for reason, n in mapping.refusals.items())
        told = f"{refused} of {len(selection)} scans could not be used ({reasons})"
        told += f"; the last: {mapping.last_refusal}"
        if not mapper.regions:
            raise ToolError(f"nothing was mapped: {told}")
        print_remark(f"{COMMAND}: {told}")
