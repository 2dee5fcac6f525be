"""A finished map as a file of the kind that its name says."""

import time
from pathlib import Path

from triquad_format.mapfile.writer import write_map
from triquad_format.records.crop import without_training
from triquad_format.records.region import MapRecord
from triquad_map.preview import previews_of

from triquad_tools.mapfiles.meshfile import MESH_SUFFIXES, export_mesh
from triquad_tools.mapfiles.source import SourceMap
from triquad_tools.plots.picture import export_picture

MAP_SUFFIX, PICTURE_SUFFIX = ".triquad", ".png"
SUFFIXES = (MAP_SUFFIX, *MESH_SUFFIXES, PICTURE_SUFFIX)


def write_output(record: MapRecord, path: Path, *, cell_m: float, training: bool) -> str:
    """Write a map file, a mesh with cells of side ``cell_m`` or a picture; return what it is.

    A map file has the state that further training needs only with ``training``.

    Raises:
        OSError: it cannot be written.
    """
    if path.suffix == MAP_SUFFIX:
        kept = record if training else without_training(record)
        info = write_map(kept, path, stamp_ns=time.time_ns(), previews=previews_of(kept))
        return f"{info.bytes:,} bytes, {len(record.regions)} regions, epoch {record.epoch}"
    if path.suffix == PICTURE_SUFFIX:
        return export_picture(SourceMap(record, time.time_ns()), None, cell_m, path)
    return export_mesh(record, None, cell_m, path)
