"""Maps as files of the kind that the name says, and the places where none is written."""

import errno
import os
import time
from collections.abc import Sequence
from pathlib import Path

from triquad_client import Mesh, OfflineMap
from triquad_format.mapfile.files import replacing
from triquad_format.mapfile.metadata import utc_time
from triquad_format.mapfile.writer import write_map
from triquad_format.records.region import MapRecord

from triquad_tools.console.arguments import (
    GRID_SUFFIX,
    MAP_SUFFIX,
    NAV2_SUFFIX,
    OCTOMAP_SUFFIX,
    PICTURE_SUFFIX,
    SUFFIXES,
)
from triquad_tools.console.command import ToolError, print_remark
from triquad_tools.console.progress import progress
from triquad_tools.mapfiles.crop import without_training
from triquad_tools.mapfiles.grid_file import write_grid
from triquad_tools.mapfiles.nav2_map import image_path, write_nav2_map
from triquad_tools.mapfiles.octomap import write_octomap
from triquad_tools.mapfiles.source import Box, NothingLeftError, SourceMap

_MARKED = (".ply", ".glb", ".obj", PICTURE_SUFFIX)  # they can show which faces were not seen


def why(error: OSError) -> str:
    """Return why something could not be written, in words where the disk is full."""
    full = error.errno in (errno.ENOSPC, errno.EDQUOT)
    return f"the disk is full ({error})" if full else str(error)


def check_target(path: Path, *, force: bool, suffixes: Sequence[str] = SUFFIXES) -> None:
    """Refuse a target that has another suffix, cannot be written, or exists, without ``force``.

    Raises:
        ToolError: with what to do instead.
    """
    if path.suffix not in suffixes:
        raise ToolError(f"{path}: use a name that ends in {', '.join(suffixes)}")
    if path.is_dir():
        raise ToolError(f"{path} is a folder; give the name of a file")
    for each in (path, image_path(path)) if path.suffix == NAV2_SUFFIX else (path,):
        if os.path.lexists(each) and not force:
            raise ToolError(f"{each} exists; give --force to replace it")
    if not path.parent.is_dir():
        raise ToolError(f"{path.parent} is not a folder: make it first")


def check_fill(path: Path, fill_m: float) -> None:
    """Refuse to continue surface by ``fill_m`` where nothing could show which that is.

    Raises:
        ToolError: with what to use.
    """
    if fill_m and path.suffix not in _MARKED:
        raise ToolError(f"--fill is of what can mark it, {', '.join(_MARKED)}: {path} cannot")


def write_output(
    record: MapRecord, path: Path, *, cell_m: float, training: bool, fill_m: float = 0.0
) -> str:
    """Write a map file, or what :func:`export` does, by the suffix; return what it is.

    A map file has the state that further training needs only with ``training``; a mesh or a picture
    has cells of side ``cell_m``, and its surface is continued by ``fill_m`` into unknown space.

    Raises:
        OSError: it cannot be written.
    """
    source = SourceMap(record if training else without_training(record), time.time_ns())
    if path.suffix != MAP_SUFFIX:
        is_grid = path.suffix in (NAV2_SUFFIX, GRID_SUFFIX)
        return export(source, path, cell_m=None if is_grid else cell_m, fill_m=fill_m)
    size = write_map_file(source, path)
    told = f"{size:,} bytes, {len(record.regions)} regions, epoch {record.epoch}"
    origin = ", origin {:.12g} {:.12g} {:.12g} m".format(*record.origin_m)
    return told + origin if record.origin.any() else told


def write_map_file(source: SourceMap, path: Path, *, feature_dtype: str = "<f2") -> int:
    """Write a map file with a preview for MCAP viewers; return its size in bytes.

    It has none, and that is told, if the libraries for it are not installed.

    Raises:
        OSError: it cannot be written.
    """
    record, stamp_ns, previews = source.record, source.stamp_ns, None
    try:
        from triquad_map.preview import previews_of

        previews = previews_of(record, stamp_ns=stamp_ns)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("triquad"):
            raise
        told = f"without a preview for MCAP viewers, as {error.name} is missing"
        print_remark(f"{told}: install triquad[preview]")
    return write_map(
        record, path, feature_dtype=feature_dtype, stamp_ns=stamp_ns, previews=previews
    ).bytes


def export(
    source: SourceMap,
    path: Path,
    *,
    box: Box | None = None,
    cell_m: float | None = None,
    fill_m: float = 0.0,
) -> str:
    """Write a mesh, a picture, a grid, an OctoMap or a map of Nav2; return what it is.

    Args:
        source: the map.
        path: the file to write.
        box: what of the map is written; of a mesh, the faces whose centroids lie in it; ``None``:
            all.
        cell_m: side of the cells; ``None``: half a leaf, of a grid a leaf. An OctoMap has leaves.
        fill_m: how far the surface of a mesh or a picture is continued into unknown space.

    Raises:
        NothingLeftError: nothing was seen in the box, or there is nothing to be drawn.
        InvalidInputError: the mesh is too large, or a library is missing.
        ToolError: what is not a mesh is too large.
        OSError: it cannot be written.
    """
    if path.suffix == OCTOMAP_SUFFIX:
        return write_octomap(source.record, path, box)
    with OfflineMap(source.record) as opened:
        if path.suffix == NAV2_SUFFIX:
            return write_nav2_map(opened, path, box, cell_m)
        if path.suffix == GRID_SUFFIX:
            return write_grid(opened, path, box, cell_m)
        bounds = None if box is None else (box[0].tolist(), box[1].tolist())
        with progress("meshing", 1.0) as report:
            mesh = opened.mesh(
                bounds, cell_m, lambda done, of: report(done / of, f"{done} blocks"), fill_m
            )
    return _write_mesh(source, mesh, path, is_cropped=box is not None)


def _write_mesh(source: SourceMap, mesh: Mesh, path: Path, *, is_cropped: bool) -> str:
    """Write a map's mesh, or a picture of it; return what it is."""
    record, is_picture = source.record, path.suffix == PICTURE_SUFFIX
    if not len(mesh.faces) and (is_picture or is_cropped):
        where = " in the box of --crop" if is_cropped else ""
        raise NothingLeftError(f"{path} is not written: no surface was seen{where}")
    if is_picture:
        from triquad_tools.plots.picture import draw_mesh  # slow to import

        when = f", {utc_time(source.stamp_ns)}" if source.stamp_ns else ""
        with progress("drawing"):  # half a minute for millions of faces
            draw_mesh(f"map {record.name!r}, epoch {record.epoch}{when}", mesh, path)
        return f"a picture of {len(mesh.faces):,} faces"
    packed = mesh.file_bytes(path.suffix)
    with replacing(path) as stream:
        stream.write(packed)
    written = f"{len(packed):,} bytes, {len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces"
    return written if mesh.filled is None else f"{written}, {mesh.filled.sum():,} of them filled"
