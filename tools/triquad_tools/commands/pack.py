"""``triquad-pack``: rewrite a map file: smaller, from history, saved from damage, or as a mesh."""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from triquad_tools.console.arguments import error_limit, positive
from triquad_tools.console.errors import ToolError

if TYPE_CHECKING:
    from triquad_tools.mapfiles.source import Box, SourceMap

OK, DAMAGED, BAD_INPUT = 0, 1, 2

_MAP, _MESHES, _GRID = ".triquad", (".ply", ".glb"), ".npz"
_SUFFIXES = (_MAP, *_MESHES, _GRID)
_MESH_CELL_M, _GRID_CELL_M = 0.1, 0.2
_CELL_RANGE_M = (0.01, 10.0)

_Add = Callable[..., argparse.Action]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool: 0 done, 1 damage, or nothing lies in the box, 2 otherwise."""
    arguments = _parser().parse_args(argv)
    from triquad_format.errors import DamagedMapFileError, FormatError

    from triquad_tools.mapfiles.source import NothingLeftError

    try:
        return _pack(arguments)
    except (DamagedMapFileError, NothingLeftError) as error:
        return _complain(error, DAMAGED)
    except (FormatError, ToolError, OSError) as error:
        return _complain(error, BAD_INPUT)
    except OverflowError:
        return _complain("its regions lie too far from the origin: use --crop", BAD_INPUT)
    except MemoryError:
        return _complain("it does not fit into memory: use --crop", BAD_INPUT)
    except KeyboardInterrupt:
        return _complain("interrupted", BAD_INPUT)


def _complain(message: object, code: int) -> int:
    print(f"triquad-pack: {message}", file=sys.stderr)
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="triquad-pack",
        description="Rewrite a map file: smaller, cropped, an earlier epoch of it, what is intact "
        "of it, in the newest version, or as a mesh or an array of distances.",
        epilog="Exit status: 0 done; 1 IN is damaged (with --recover: something of it is lost), or "
        "nothing lies in the box; 2 wrong usage, or input that cannot be used.",
    )
    _add_source(parser.add_argument)
    _add_content(parser.add_argument)
    _add_target(parser.add_argument)
    return parser


def _add_source(add: _Add) -> None:
    add("input", type=Path, metavar="IN", help="map file, or folder of checkpoints")
    add("output", type=Path, metavar="OUT", help="its name ends in " + ", ".join(_SUFFIXES))
    add(
        "--at",
        metavar="EPOCH_OR_TIME",
        help="take the newest checkpoint of the folder IN that is not after this, such as 120 or "
        "2026-01-31T12:00:00Z (default: the newest of all)",
    )
    add("--recover", action="store_true", help="save what is intact of a damaged file")


def _add_content(add: _Add) -> None:
    add("--precision", choices=("fp16", "fp32", "int8"), help="of features (default: as in IN)")
    add(
        "--max-error",
        type=error_limit,
        metavar="LENGTH",
        help="features as coarse integers as move 99 %% of distances by less than this, such as "
        "2mm; drops training state (default with int8: 1.5mm)",
    )
    add(
        "--crop",
        type=float,
        nargs=6,
        metavar=("XMIN", "YMIN", "ZMIN", "XMAX", "YMAX", "ZMAX"),
        help="keep what answers in this box need, metres, map frame; only that is read, unless IN "
        "has training state that is kept",
    )
    add("--no-training", action="store_true", help="drop what only further training needs")


def _add_target(add: _Add) -> None:
    add(
        "--cell",
        type=positive,
        metavar="M",
        help=f"side of cells (default: {_MESH_CELL_M:g} of a mesh, {_GRID_CELL_M:g} of {_GRID})",
    )
    add("--sparse", action="store_true", help=f"{_GRID}: only blocks around surface, not a box")
    add("--force", action="store_true", help="replace OUT where it exists")


def _pack(arguments: argparse.Namespace) -> int:
    from triquad_tools.mapfiles.source import chosen_file, epoch_of

    _check_usage(arguments)
    path = chosen_file(arguments.input, arguments.at)
    _check_target(path, arguments.output, arguments.force)
    if path != arguments.input:
        print(f"epoch {epoch_of(path)}, from {path}")
        if arguments.at is None:
            _tell_set_aside(path)
    if arguments.output.suffix == _MAP:
        return _pack_map(arguments, path)
    return _export(arguments, path)


def _tell_set_aside(path: Path) -> None:
    """Name the newer checkpoints beside the newest sound one, which were damaged."""
    from triquad_format.mapfile.history import set_aside

    for newer in (aside for aside in set_aside(path.parent) if aside.name > path.name):
        print(f"triquad-pack: {newer} is newer, but damaged: --recover saves what is intact of it")


def _check_usage(arguments: argparse.Namespace) -> None:
    """Refuse options that do not go together."""
    suffix = arguments.output.suffix
    rounds = arguments.precision or arguments.max_error
    problems = {
        f"{arguments.output}: use a name that ends in {', '.join(_SUFFIXES)}": (
            suffix not in _SUFFIXES
        ),
        f"--precision and --max-error are of map files: {suffix} has none": (
            rounds and suffix != _MAP
        ),
        f"--max-error makes integers: leave out --precision {arguments.precision}": (
            arguments.max_error and arguments.precision in ("fp16", "fp32")
        ),
        "--cell is of meshes and grids: a map file has none": arguments.cell and suffix == _MAP,
        f"--sparse is of {_GRID}": arguments.sparse and suffix != _GRID,
    }
    for problem, there in problems.items():
        if there:
            raise ToolError(problem)


def _check_target(source: Path, target: Path, force: bool) -> None:
    """Refuse a target that must not be written."""
    from triquad_format.mapfile.history import checkpoint_file, checkpoint_files

    folder = target.parent
    named_so = checkpoint_file(target) is not None
    if named_so and folder.is_dir() and checkpoint_files(folder):
        raise ToolError(f"{target} would pass for a checkpoint of {folder}; give another name")
    if os.path.lexists(target):
        if source.exists() and target.exists() and target.samefile(source):
            raise ToolError(f"{target} is the input; write to another file")
        if target.is_dir():
            raise ToolError(f"{target} is a folder; give the name of a file")
        if not force:
            raise ToolError(f"{target} exists; give --force to replace it")
    elif not target.parent.is_dir():
        raise ToolError(f"{target.parent} is not a folder: make it first")


def _pack_map(arguments: argparse.Namespace, path: Path) -> int:
    from triquad_tools.mapfiles.packing import chosen_precision, pack_map, print_packed

    precision = chosen_precision(arguments.precision, arguments.max_error)
    training = not arguments.no_training and precision.max_error_m is None
    source, complete = _source(arguments, path, _box(arguments.crop), training)
    packed = pack_map(source, precision, arguments.output)
    print_packed(arguments.output, packed, path.stat().st_size)
    return OK if complete else DAMAGED


def _export(arguments: argparse.Namespace, path: Path) -> int:
    from triquad_format.records.field_settings import check_range

    from triquad_tools.mapfiles.export import MARGIN_CELLS, export_grid, export_mesh

    box, output = _box(arguments.crop), arguments.output
    grid = output.suffix == _GRID
    cell_m = arguments.cell or (_GRID_CELL_M if grid else _MESH_CELL_M)
    check_range("--cell", cell_m, *_CELL_RANGE_M)
    needed = None if box is None else box + [[-MARGIN_CELLS * cell_m], [MARGIN_CELLS * cell_m]]
    source, complete = _source(arguments, path, needed, training=False)
    if grid:
        written = export_grid(source.record, box, cell_m, arguments.sparse, output)
    else:
        written = export_mesh(source.record, box, cell_m, output)
    print(f"{output}: {written}")
    return OK if complete else DAMAGED


def _box(corners: list[float] | None) -> "Box | None":
    import numpy as np

    return None if corners is None else np.reshape(np.array(corners), (2, 3))


def _source(
    arguments: argparse.Namespace, path: Path, box: "Box | None", training: bool
) -> "tuple[SourceMap, bool]":
    """The map, and whether nothing of it is lost."""
    from triquad_tools.mapfiles.source import SourceMap, cropped, read_source

    if not arguments.recover:
        return read_source(path, box, training), True
    from triquad_format.recovery.recover import recover

    from triquad_tools.mapfiles.recovery_report import print_recovery

    recovery = recover(path)
    print_recovery(recovery)
    source = SourceMap(recovery.record, recovery.stamp_ns or None)
    return cropped(source, box, training), recovery.complete


if __name__ == "__main__":
    sys.exit(main())
