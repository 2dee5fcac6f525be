"""``triquad-map``: a recording in, a map out."""

import argparse
import shutil
from collections.abc import Mapping
from contextlib import closing

from triquad_server.errors import StoreError
from triquad_server.mapping.mapper import Mapper
from triquad_server.process.installed import check_device
from triquad_server.process.threads import Teams
from triquad_server.settings import Settings
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
    check_target(options.output, force=options.force)
    check_fill(options.output, options.fill)
    settings = load_settings(options.settings, options.set, preset=options.preset)
    check_device(options.device)
    if options.workers is not None or options.cluster is not None:
        return _by_workers(options, settings)
    return _alone(options, settings)


def _alone(options: argparse.Namespace, settings: Settings) -> int:
    """Make a map in this process, or go on with one that was interrupted."""
    selection, output = open_selected(options), options.output
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
    told = _refused(mapping.refusals, mapping.last_refusal, len(selection))
    if told and not mapper.regions:
        raise ToolError(f"nothing was mapped: {told}")
    if told:
        print_remark(f"{COMMAND}: {told}")
    if "map_full" in mapping.refusals:
        print_remark("--workers 2 maps region by region: then the map may be larger than memory")


def _refused(refusals: Mapping[str, int], last: str, total: int) -> str:
    """Return how many of the scans could not be used, and why; empty: all could."""
    if not refusals:
        return ""
    reasons = ", ".join(f"{reason}: {n}" for reason, n in refusals.items())
    refused = sum(refusals.values())
    return f"{refused} of {total} scans could not be used ({reasons}); the last: {last}"


def _by_workers(options: argparse.Namespace, settings: Settings) -> int:
    """Make a map by many processes, or go on with one that was interrupted."""
    if options.workers is not None and options.cluster is not None:
        raise ToolError("--workers are processes of this machine, and --cluster has others: choose")
    if options.device != "cpu" or options.train_for is not None:
        raise ToolError(
            "--workers and --cluster compute on CPUs, and train until all has settled: leave out "
            "--device and --train-for"
        )
    try:
        from triquad_tools.mapping.batch.batch_run import BatchRun
        from triquad_tools.mapping.batch.job import place_of
        from triquad_tools.mapping.batch.workers import check_workers, opened
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("triquad"):
            raise
        raise ToolError(f"{error.name} is missing: install triquad[cluster]") from error
    options.recordings = [path.resolve() for path in options.recordings]  # as workers find them
    selection, output = open_selected(options), options.output.resolve()
    folder = output.with_name(f"{output.name}.parts")
    with progress("preparing") as report:
        warm_up(settings, "cpu", report=lambda stage: report(0.0, stage))
    with opened(options.cluster, options.workers) as client:
        place = place_of(selection, settings)
        folder.mkdir(exist_ok=True)
        check_workers(client, [folder, *options.recordings])
        run = BatchRun(client, selection, place, folder)
        record = run.record(training=options.training)
    if run.refused:
        *_, last = run.refused.values()
        print_remark(f"{COMMAND}: {_refused(run.refusals, last.text, len(selection))}")
    cell_m, fill_m = settings.mesh.cell_m, options.fill
    try:
        written = write_output(
            record, output, cell_m=cell_m, training=options.training, fill_m=fill_m
        )
    except OSError as error:
        raise StoreError(
            f"{output} cannot be written: {why(error)}; the regions are in {folder}: the same "
            "command writes the map once there is room"
        ) from error
    print_line(f"{options.output}: {written}")
    shutil.rmtree(folder)
    return OK
