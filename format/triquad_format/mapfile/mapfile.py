"""The map file: how a map is kept and handed on. ``docs/map-file.md`` is the specification."""

from triquad_format.mapfile.container import FORMAT_VERSION, MAX_MAP_BYTES
from triquad_format.mapfile.file_metadata import KNOWN_FEATURES
from triquad_format.mapfile.reader import MapFile, StoredPart, read_map, read_map_file
from triquad_format.mapfile.writer import write_map
from triquad_format.mapfile.written_map import MapFileInfo

SUFFIX = ".triquad"

__all__ = [
    "FORMAT_VERSION",
    "KNOWN_FEATURES",
    "MAX_MAP_BYTES",
    "SUFFIX",
    "MapFile",
    "MapFileInfo",
    "StoredPart",
    "read_map",
    "read_map_file",
    "write_map",
]
