"""Reading map files and checkpoints, whole or in part: nothing of them is used before its check."""

import dataclasses
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from triquad_format.mapfile.checkpoint_folder import CheckpointFile
from triquad_format.mapfile.container import RandomAccess
from triquad_format.mapfile.files import FileBytes, named
from triquad_format.mapfile.index import open_index
from triquad_format.mapfile.manifest import Entry, Manifest
from triquad_format.mapfile.parts.part import (
    FIELD_TOPICS,
    REGION,
    VERTICES,
    PartKey,
    extent,
    vertex_reach,
)
from triquad_format.mapfile.parts.region_parts import RegionParts
from triquad_format.mapfile.record_check import check_record
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.leaf_box import LeafBox, check_box, leaf_box, whole_region
from triquad_format.records.region import MapRecord


@dataclass(frozen=True)
class MapFile:
    """A map file, or a checkpoint, that has passed every check."""

    record: MapRecord
    metadata: dict[str, str]  # of the record "triquad"
    size: int  # bytes; of a checkpoint, with all its parts
    manifest: Manifest


class StoredMap:
    """A map file or checkpoint, open for reading. One thread at a time may use it."""

    def __init__(self, source: RandomAccess) -> None:
        """Read the manifest; errors are those of :func:`open_index`."""
        self.name = source.name
        with named(self.name):
            self._index = open_index(source)
        self._settings = self.manifest.facts.settings
        self._indices = [e.key.region for e in self.manifest.entries if e.key.topic == REGION]

    @classmethod
    def open(cls, path: Path | str) -> "StoredMap":
        """Return the map in a file, or of a checkpoint in its store.

        Raises:
            MapFileError: it is not a map file, is damaged, or needs a newer reader.
            OSError: it cannot be read.
        """
        source = FileBytes(Path(path))
        try:
            return cls(source)
        except BaseException:
            source.close()
            raise

    def __enter__(self) -> "StoredMap":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def manifest(self) -> Manifest:
        """All parts of the map."""
        return self._index.manifest

    def close(self) -> None:
        """Close the file."""
        self._index.close()

    def whole(self) -> MapFile:
        """Return the map, after a check of all of the file.

        Raises:
            MapFileError: something of it is damaged.
        """
        with named(self.name):
            self.manifest.check_total(self._index.size)  # a checkpoint may have more
            self._index.check_unread()
            record = assemble(self.manifest, self._index.payload)
        return MapFile(record, self._index.metadata, self._index.size, self.manifest)

    def regions(self, wanted: Collection[RegionIndex]) -> MapRecord:
        """Return those regions of the map that are ``wanted``, whole; those it lacks are left out.

        Raises:
            MapFileError: a part of them is missing or damaged.
        """
        entries = tuple(one for one in self.manifest.entries if one.key.region in wanted)
        with named(self.name):
            return assemble(
                dataclasses.replace(self.manifest, entries=entries), self._index.payload
            )

    def box(self, minimum: ArrayLike, maximum: ArrayLike) -> MapRecord:
        """Return the part of the map that answers in a box, without training state.

        It has whole squares and cubes: :func:`triquad_tools.mapfiles.crop.crop_record` takes off
        what the box does not need.

        Args:
            minimum: ``[3]`` corner of the box, metres, map frame.
            maximum: ``[3]`` opposite corner.

        Raises:
            FormatError: the corners are not finite or not in order.
            MapFileError: a part is damaged.
        """
        wanted = dataclasses.replace(self.manifest, entries=self.parts_in(minimum, maximum))
        with named(self.name):
            return assemble(wanted, self._index.payload)

    def parts_in(self, minimum: ArrayLike, maximum: ArrayLike) -> tuple[Entry, ...]:
        """Return the parts that :meth:`box` consists of; arguments and errors are the same."""
        low, high = np.subtract(check_box(minimum, maximum), self.manifest.facts.origin_m)
        boxes = {index: leaf_box(self._settings, index, low, high) for index in self._indices}
        return tuple(
            entry
            for entry in self.manifest.entries
            if entry.key.topic in FIELD_TOPICS
            and boxes[entry.key.region].meets(whole_region(self._settings))
            and self._reaches(entry.key, boxes[entry.key.region])
        )

    def payload(self, entry: Entry) -> bytes:
        """Return the payload of a part that the manifest lists, as it is written.

        Raises:
            MapFileError: the part is missing or damaged.
        """
        with named(self.name):
            return self._index.payload(entry)

    def _reaches(self, key: PartKey, box: LeafBox) -> bool:
        """Return whether a part contains something that answers in a box."""
        slack = vertex_reach(self._settings) if key.topic == VERTICES else 1
        return box.meets(extent(self._settings, key), slack)


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
    with StoredMap.open(path) as stored:
        return stored.whole()


def open_manifest(file: CheckpointFile) -> Manifest:
    """Return the manifest of a checkpoint; no part is read. Errors are those of StoredMap.open."""
    with StoredMap.open(file.path) as stored:
        return stored.manifest


def assemble(manifest: Manifest, payload_of: Callable[[Entry], bytes]) -> MapRecord:
    """Return the checked record of the parts of regions that a manifest lists.

    Args:
        manifest: the list; regions come in the order of their parts ``/triquad/region``.
        payload_of: gives the checked payload of a part; it is asked once for each.

    Raises:
        FormatError: a part is missing, malformed or does not fit the others.
    """
    facts = manifest.facts
    regions = []
    for index, entries in manifest.of_regions().items():
        parts = RegionParts(index, facts.settings)
        for entry in entries:
            parts.add(entry.key, payload_of(entry))
        regions.append(parts.region())
    record = dataclasses.replace(facts, regions=tuple(regions))
    check_record(record)
    return record
