"""``triquad-pack``: rewrite a map file: smaller, from history, repaired, or as something else."""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from triquad_format.mapfile.checkpoint_folder import checkpoint_file, checkpoint_files, set_aside
from triquad_format.mapfile.index import read_checkpoint
from triquad_format.mapfile.parts.part import EVIDENCE, REGION, TRAINING, VERTICES
from triquad_format.records.pose import upright_pose
from triquad_format.records.region import VertexTable

from triquad_tools.commands.pack import COMMAND
from triquad_tools.console.arguments import (
    GRID_SUFFIX,
    MAP_SUFFIX,
    OCTOMAP_SUFFIX,
    SCANS_SUFFIX,
    SUFFIXES,
)
from triquad_tools.console.command import FAILED, OK, ToolError, complain, print_line, refuse
from triquad_tools.mapfiles.crop import without_training
from triquad_tools.mapfiles.grid_file import REACH_M
from triquad_tools.mapfiles.quantise import quantise
from triquad_tools.mapfiles.recovery import Loss, RecoveredMap, recover
from triquad_tools.mapfiles.scan_export import export_scans
from triquad_tools.mapfiles.source import (
    Box,
    SourceMap,
    chosen_file,
    cropped,
    is_endpoint,
    read_source,
)
from triquad_tools.mapping.output import check_fill, check_target, export, write_map_file

_PLANES = ("XY", "XZ", "YZ")
_MARGIN_M = 3.2  # so far around its box a map is needed for a mesh of cells of 0.2 m
_MARGIN_CELLS = 16  # or of larger ones


def work(options: argparse.Namespace) -> int:
    """Write a map file, or what :func:`export` makes of a map."""
    _check_usage(options)
    if options.output.suffix == SCANS_SUFFIX:
        check_target(options.output, force=options.force, suffixes=(SCANS_SUFFIX,))
        print_line(f"{options.output}: {export_scans(options.input, options.output)}")
        return OK
    path = chosen_file(options.input, options.at)
    _check_target(path, options.output, options.force)
    if path != options.input:
        checkpoint = checkpoint_file(path)
        print_line(f"epoch {checkpoint and checkpoint.epoch}, from {path}")
        # Those newer than the newest valid one, which were damaged.
        for newer in set_aside(path.parent) if options.at is None else ():
            if newer.name > path.name:
                told = "is newer, but damaged: --recover saves what is intact of it"
                print_line(f"{COMMAND}: {newer} {told}")
    write = _pack_map if options.output.suffix == MAP_SUFFIX else _export
    try:
        return write(options, path)
    except MemoryError as error:
        raise ToolError("it does not fit into memory: use --crop") from error


def _check_usage(options: argparse.Namespace) -> None:
    given, suffix = options.input, options.output.suffix
    is_map = suffix == MAP_SUFFIX
    problems = {
        f"{given} is a server: give its store, or what client.download_map saved": (
            is_endpoint(str(given))
        ),
        f"--max-error is of map files: {suffix} has none": options.max_error and not is_map,
        "--cell is of meshes and grids: a map file has none": options.cell and is_map,
        f"--cell is of meshes and grids: {suffix} has the map's leaves": (
            options.cell and suffix == OCTOMAP_SUFFIX
        ),
        f"{suffix} has scans: --at, --recover, --merge, --crop and --cell are of maps": (
            suffix == SCANS_SUFFIX
            and any((options.at, options.recover, options.merge, options.crop, options.cell))
        ),
        "--merge is of whole maps: crop what it has made, or recover a map before": (
            bool(options.merge and (options.crop or options.recover))
        ),
        "--align is for --merge: it moves the map that is joined": (
            options.align is not None and options.merge is None
        ),
    }
    refuse(problems)
    check_fill(options.output, options.fill)


def _check_target(source: Path, target: Path, force: bool) -> None:
    folder = target.parent
    named_so = checkpoint_file(target) is not None
    if named_so and folder.is_dir() and checkpoint_files(folder):
        raise ToolError(f"{target} would pass for a checkpoint of {folder}; give another name")
    if source.exists() and target.exists() and target.samefile(source):
        raise ToolError(f"{target} is the input; write to another file")
    check_target(target, force=force, suffixes=(*SUFFIXES, SCANS_SUFFIX))


def _pack_map(options: argparse.Namespace, path: Path) -> int:
    source, complete = _source(options, path, _box(options.crop))
    if options.no_training:
        source = replace(source, record=without_training(source.record))
    told = ""
    if options.max_error is not None:
        source, told = _quantised(source, options.max_error)
    # What keeps all float features as they are.
    dtypes = {table.features.dtype.str for table in _tables(source) if len(table.codes)}
    dtype = "<f4" if "<f4" in dtypes else "<f2"
    size = write_map_file(source, options.output, feature_dtype=dtype)
    checkpoint = read_checkpoint(path)
    before = path.stat().st_size + (checkpoint.manifest.stored_bytes if checkpoint else 0)
    print_line(f"{options.output}: {size:,} bytes, {size / before:.0%} of {before:,}{told}")
    return OK if complete else FAILED


def _quantised(source: SourceMap, max_error_m: float) -> tuple[SourceMap, str]:
    """Return a map with features as integers, and lines that say how far distances moved."""
    if any(table.scale is not None for table in _tables(source)):
        complain(COMMAND, "features are integers already: both errors add up", OK)
    packed = quantise(source.record, max_error_m)
    change = packed.change
    most, largest = (f"{1e3 * one:.2f} mm" for one in (change.quantile_m, change.largest_m))
    return SourceMap(packed.record, source.stamp_ns), (
        f"\n  99 % of distances near surface moved by less than {most}, the most by {largest}\n"
        "  without training state: it does not fit rounded features"
    )


def _tables(source: SourceMap) -> list[VertexTable]:
    return [table for region in source.record.regions for table in region.tables]


def _export(options: argparse.Namespace, path: Path) -> int:
    box, output = _box(options.crop), options.output
    margin_m = max(_MARGIN_M, _MARGIN_CELLS * (options.cell or 0.0)) + options.fill
    if output.suffix == GRID_SUFFIX:
        margin_m += REACH_M
    needed = None if box is None else box + [[-margin_m], [margin_m]]
    source, complete = _source(options, path, needed)
    written = export(source, output, box=box, cell_m=options.cell, fill_m=options.fill)
    print_line(f"{output}: {written}")
    return OK if complete else FAILED


def _box(corners: list[float] | None) -> Box | None:
    if corners is None:
        return None
    box = np.reshape(np.array(corners), (2, 3))
    if not (box[0] < box[1]).all():
        raise ToolError("the box of --crop holds nothing: XMIN YMIN ZMIN lie below XMAX YMAX ZMAX")
    return box


def _source(options: argparse.Namespace, path: Path, box: Box | None) -> tuple[SourceMap, bool]:
    if options.merge is not None:
        return _merged(options, path), True
    if not options.recover:
        return read_source(path, box), True
    recovery = recover(path)
    _print_recovery(recovery)
    source = SourceMap(recovery.record, recovery.stamp_ns)
    return source if box is None else cropped(source, box), recovery.complete


def _merged(options: argparse.Namespace, path: Path) -> SourceMap:
    """Return the map joined with another one."""
    try:
        from triquad_tools.mapping.merge import merged
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("triquad"):
            raise
        raise ToolError(f"{error.name} is missing: install triquad[server]") from error

    other = read_source(chosen_file(options.merge, None), None)
    own = read_source(path, None)
    guess = None if options.align is None else upright_pose(*options.align)
    record = merged(other.record, own.record, guess=guess)
    return SourceMap(record, max(other.stamp_ns, own.stamp_ns))


def _print_recovery(recovery: RecoveredMap) -> None:
    for loss in recovery.losses:
        print_line(f"lost: {_what(loss)}")
    if recovery.parts_listed is None:
        saved = f"saved {recovery.parts_intact} parts"
        print_line(f"{saved}; the list of parts is lost: there may have been more")
    elif recovery.complete:
        print_line(f"saved all {recovery.parts_listed} parts: nothing is lost")
    else:
        print_line(f"saved {recovery.parts_intact} of {recovery.parts_listed} parts")
    if not recovery.record.has_evidence:
        print_line("no evidence is left: the map gives distances, but says UNKNOWN everywhere")


def _what(loss: Loss) -> str:
    region = "region {} {} {}".format(*loss.key.region)
    if loss.key.topic == TRAINING:
        return f"training state of {region}: it answers, but learns from the start"
    bounds = zip("xyz", loss.minimum.tolist(), loss.maximum.tolist(), strict=True)
    where = ", ".join(f"{axis} {low:.1f} to {high:.1f} m" for axis, low, high in bounds)
    what = {
        REGION: f"{region}, all of it",
        VERTICES: f"vertices of plane {_PLANES[loss.key.plane]} of {region}: now UNKNOWN",
        EVIDENCE: f"evidence of {region}: now UNKNOWN",
    }[loss.key.topic]
    return f"{what}, {where}"
