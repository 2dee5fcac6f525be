"""Reading map files whole: nothing of a file is used before it is checked."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from triquad_format.mapfile.checkpoint_folder import CheckpointFile
from triquad_format.mapfile.files import FileBytes, named
from triquad_format.mapfile.index import open_index
from triquad_format.mapfile.manifest import Entry, Manifest
from triquad_format.mapfile.parts.part import REGION, REGION_TOPICS
from triquad_format.mapfile.parts.region_parts import RegionParts
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.record_check import check_record
from triquad_format.records.region import MapRecord


@dataclass(frozen=True)
class MapFile:
    """A map file, or a checkpoint, that has passed every check."""

    record: MapRecord
    metadata: dict[str, str]  # of the record "triquad"
    size: int  # bytes; of a checkpoint, with all its parts
    manifest: Manifest


def read_map(path: Path | str) -> MapRecord:
    """Return the record in a map file; errors are those of :func:`read_map_file`."""
    return read_map_file(path).record


def read_map_file(path: Path | str) -> MapFile:
    """Read a map file, or a checkpoint in its store, and check all of it.

    Raises:
        DamagedMapFileError: bytes are missing or altered.
        UnsupportedMapFileError: the file needs a newer reader.
        TooLargeMapFileError: it exceeds the limits of map files, or the memory there is.
        MapFileError: it is not a map file.
        OSError: the file cannot be read.
    """
    with closing(FileBytes(Path(path))) as file, named(file.name):
        index = open_index(file)
        index.check_unread()
        record = assemble(index.manifest, index.payload)
        check_record(record)
        return MapFile(record, index.metadata, index.size, index.manifest)


def open_manifest(file: CheckpointFile) -> Manifest:
    """Return the manifest of a checkpoint; no part is read.

    Raises:
        MapFileError: the file is damaged, or needs a newer reader.
        OSError: it cannot be read.
    """
    with closing(FileBytes(file.path)) as source, named(str(file.path)):
        return open_index(source).manifest


def assemble(manifest: Manifest, payload_of: Callable[[Entry], bytes]) -> MapRecord:
    """Return the record of the parts of regions that a manifest lists.

    Args:
        manifest: the list; regions come in the order of their parts ``/triquad/region``.
        payload_of: gives the checked payload of a part; it is asked once for each.

    Raises:
        FormatError: a part is missing, malformed or does not fit the others.
    """
    facts = manifest.facts
    by_region: dict[RegionIndex, list[Entry]] = {}
    for entry in manifest.entries:
        if entry.key.topic == REGION:
            by_region[entry.key.region] = []
    for entry in manifest.entries:
        if entry.key.topic in REGION_TOPICS:
            by_region[entry.key.region].append(entry)
    regions = []
    for index, entries in by_region.items():
        parts = RegionParts(index, facts.settings)
        for entry in entries:
            parts.add(entry.key, payload_of(entry))
        regions.append(parts.region())
    return facts.record(tuple(regions))
