"""Maps as files of the kind that the name says, and the places where none is written."""

import os
import time
from pathlib import Path

from triquad_format.mapfile.writer import write_map
from triquad_format.records.crop import without_training
from triquad_format.records.region import MapRecord

from triquad_tools.console.command import ToolError
from triquad_tools.mapfiles.meshfile import MESH_SUFFIXES, export_mesh
from triquad_tools.mapfiles.source import Box, SourceMap

MAP_SUFFIX, PICTURE_SUFFIX = ".triquad", ".png"
SUFFIXES = (MAP_SUFFIX, *MESH_SUFFIXES, PICTURE_SUFFIX)


def check_target(path: Path, *, force: bool) -> None:
    """Refuse a target that cannot be written, or that exists, without ``force``.

    Raises:
        ToolError: with what to do instead.
    """
    if path.suffix not in SUFFIXES:
        raise ToolError(f"{path}: use a name that ends in {', '.join(SUFFIXES)}")
    if path.is_dir():
        raise ToolError(f"{path} is a folder; give the name of a file")
    if os.path.lexists(path) and not force:
        raise ToolError(f"{path} exists; give --force to replace it")
    if not path.parent.is_dir():
        raise ToolError(f"{path.parent} is not a folder: make it first")


def write_output(record: MapRecord, path: Path, *, cell_m: float, training: bool) -> str:
    """Write a map file, a mesh with cells of side ``cell_m`` or a picture; return what it is.

    A map file has the state that further training needs only with ``training``.

    Raises:
        OSError: it cannot be written.
    """
    if path.suffix != MAP_SUFFIX:
        return export(SourceMap(record, time.time_ns()), path, cell_m=cell_m)
    from triquad_map.preview import previews_of  # which triquad-pack can do without

    kept = record if training else without_training(record)
    info = write_map(kept, path, stamp_ns=time.time_ns(), previews=previews_of(kept))
    return f"{info.bytes:,} bytes, {len(record.regions)} regions, epoch {record.epoch}"


def export(
    source: SourceMap,
    path: Path,
    *,
    box: Box | None = None,
    cell_m: float | None = None,
    fill_m: float = 0.0,
) -> str:
    """Write a mesh or a picture of a map; return what it is.

    Raises:
        NothingLeftError: no surface was seen in the box.
        InvalidInputError: the mesh is too large, or a library is missing.
        OSError: it cannot be written.
    """
    if path.suffix != PICTURE_SUFFIX:
        return export_mesh(source.record, box, cell_m, path, fill_m)
    from triquad_tools.plots.picture import export_picture  # slow to import

    return export_picture(source, box, cell_m, path)
