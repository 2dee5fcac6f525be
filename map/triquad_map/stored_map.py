"""A map file, or a checkpoint, that is read part by part, as far as it is needed."""

import dataclasses
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from triquad_format.mapfile.container import RandomAccess
from triquad_format.mapfile.files import FileBytes, named
from triquad_format.mapfile.index import open_index
from triquad_format.mapfile.manifest import Entry, Manifest
from triquad_format.mapfile.parts.part import (
    FIELD_TOPICS,
    REGION,
    REGION_TOPICS,
    VERTICES,
    PartKey,
    extent,
    vertex_reach,
)
from triquad_format.mapfile.reader import assemble
from triquad_format.records.leaf_box import LeafBox, check_box, leaf_box, whole_region
from triquad_format.records.record_check import check_record
from triquad_format.records.region import MapRecord


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

    def record(self, training: bool = True) -> MapRecord:
        """Return the whole map, read part by part.

        Raises:
            MapFileError: a part is damaged.
        """
        topics = REGION_TOPICS if training else FIELD_TOPICS
        return self._assembled(
            entry for entry in self.manifest.entries if entry.key.topic in topics
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
        return self._assembled(self.parts_in(minimum, maximum))

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

    def _assembled(self, entries: Iterable[Entry]) -> MapRecord:
        chosen = dataclasses.replace(self.manifest, entries=tuple(entries))
        with named(self.name):
            record = assemble(chosen, self._index.payload)
            check_record(record)
        return record

    def _reaches(self, key: PartKey, box: LeafBox) -> bool:
        """Return whether a part contains something that answers in a box."""
        slack = vertex_reach(self._settings) if key.topic == VERTICES else 1
        return box.meets(extent(self._settings, key), slack)
