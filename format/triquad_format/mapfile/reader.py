"""Reading map files whole: nothing of a file is used before it is checked."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from triquad_format.errors import TooLargeMapFileError
from triquad_format.mapfile.checkpoint import CheckpointIndex, open_index
from triquad_format.mapfile.index import FileBytes, MapIndex, named
from triquad_format.mapfile.manifest import Entry, Manifest
from triquad_format.mapfile.metadata import MAX_MAP_BYTES
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


def read_map(path: Path | str, *, max_bytes: int = MAX_MAP_BYTES) -> MapRecord:
    """Return the record in a map file; arguments and errors are those of :func:`read_map_file`."""
    return read_map_file(path, max_bytes=max_bytes).record


def read_map_file(path: Path | str, *, max_bytes: int = MAX_MAP_BYTES) -> MapFile:
    """Read a map file and check all of it. Arrays may be read-only.

    Args:
        path: the file; it may be a checkpoint, whose parts lie in its store.
        max_bytes: limit on the file's size and, decompressed, on its parts together.

    Raises:
        DamagedMapFileError: bytes are missing or altered.
        UnsupportedMapFileError: the file needs a newer reader.
        TooLargeMapFileError: it exceeds ``max_bytes``, or the memory there is.
        MapFileError: it is not a map file.
        OSError: the file cannot be read.
    """
    with closing(FileBytes(Path(path))) as file, named(file.name):
        if file.size > max_bytes:
            raise TooLargeMapFileError(f"it is larger than the limit of {max_bytes} bytes")
        return _read(open_index(file), max_bytes)


def _read(index: MapIndex | CheckpointIndex, max_bytes: int) -> MapFile:
    manifest = index.manifest
    if sum(entry.size for entry in manifest.entries) > max_bytes:
        raise TooLargeMapFileError(f"its parts exceed the limit of {max_bytes} bytes together")
    index.check_unread()
    record = assemble(manifest, index.payload)
    check_record(record)
    return MapFile(record, index.metadata, index.size, manifest)


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
    return MapRecord(facts.name, facts.epoch, facts.settings, tuple(regions), facts.progress)
