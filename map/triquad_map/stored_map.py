"""A map file, or a checkpoint, that answers unread: parts are read when a point needs them."""

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from triquad_format.mapfile.checkpoint import open_index
from triquad_format.mapfile.container import RandomAccess
from triquad_format.mapfile.index import FileBytes, named
from triquad_format.mapfile.manifest import Entry, Manifest
from triquad_format.mapfile.parts.part import (
    EVIDENCE,
    FIELD_TOPICS,
    REGION,
    REGION_TOPICS,
    VERTICES,
    PartKey,
    cells_near,
    cube_shift,
    extent,
    square_shift,
    vertex_reach,
)
from triquad_format.mapfile.parts.region_parts import RegionParts
from triquad_format.mapfile.reader import assemble
from triquad_format.records.arrays import Doubles
from triquad_format.records.crop import SLACK_LEAVES, LeafBox, check_box, leaf_box, whole_region
from triquad_format.records.field_settings import FieldSettings, RegionIndex
from triquad_format.records.record_check import check_record, check_region
from triquad_format.records.region import AXES, MapRecord, Region

from triquad_map.composition.field_view import FieldView
from triquad_map.reference.evaluator import checked_points, in_chunks
from triquad_map.reference.region_field import RegionField
from triquad_map.reference.seen_blocks import SeenBlocks
from triquad_map.view import FieldAnswer


class StoredMap:
    """A map file or checkpoint, open for reading. One thread at a time may use it."""

    def __init__(self, source: RandomAccess) -> None:
        """Read the manifest; errors are those of :func:`open_index`."""
        self.name = source.name
        with named(self.name):
            self._index = open_index(source)
        self._settings = self.manifest.facts.settings
        self._loaded: set[PartKey] = set()
        self._by_key = {entry.key: entry for entry in self.manifest.entries}
        self._indices = [e.key.region for e in self.manifest.entries if e.key.topic == REGION]
        self._regions: dict[RegionIndex, PartialRegion] = {}
        self._view = FieldView(self._settings, [], split=in_chunks)

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

    def query(self, points: NDArray[np.floating], gradient: bool = False) -> FieldAnswer:
        """Return distance, status and, on request, gradient: as :class:`MapEvaluator` gives them.

        Raises:
            MapFileError: a part that is needed is damaged.
        """
        positions = checked_points(points)
        with named(self.name):
            self._load(self._needed_at(positions))
        return self._view.query(positions, gradient)

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

        It has whole squares and cubes: :func:`triquad_format.records.crop.crop_record` takes off
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
        low, high = check_box(minimum, maximum)
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

    def _needed_at(self, points: Doubles) -> set[PartKey]:
        """Return parts on which answers at points [N, 3] depend."""
        needed: set[PartKey] = set()
        half = self._settings.region_side_m / 2
        reach = vertex_reach(self._settings) + SLACK_LEAVES
        for index in self._indices:
            offset = points - self._settings.region_centre(index)
            offset = offset[(np.abs(offset) < half).all(axis=1)]
            if not len(offset):
                continue
            needed.add(PartKey(REGION, index))
            leaves = self._settings.leaf_coordinates(offset)
            for plane, axes in enumerate(AXES):
                cells = cells_near(leaves[:, axes], reach)
                needed |= {PartKey(VERTICES, index, plane, cell) for cell in cells}
            needed |= {PartKey(EVIDENCE, index, 0, cell) for cell in cells_near(leaves, 1)}
        return needed & self._by_key.keys()

    def _load(self, keys: set[PartKey]) -> None:
        """Read what is not there yet; of each region all or nothing."""
        missing = sorted(keys - self._loaded)
        if not missing:
            return
        for index in sorted({key.region for key in missing}):
            new = [key for key in missing if key.region == index]
            payloads = {key: self._index.payload(self._by_key[key]) for key in new}
            head = payloads.pop(PartKey(REGION, index), b"")
            region = self._regions.get(index) or PartialRegion(self._settings, index, head)
            region.add(payloads)
            self._regions[index] = region
            self._loaded.update(new)
        # Blending adds up regions in their order, which is that of the file.
        there = [self._regions[index] for index in self._indices if index in self._regions]
        self._view = FieldView(self._settings, there, split=in_chunks)


class PartialRegion:
    """Field and status of a region; they are right where all is there that they depend on."""

    def __init__(self, settings: FieldSettings, index: RegionIndex, head: bytes) -> None:
        """Begin a region of which nothing is there but its ``head``: the part ``/triquad/region``.

        Raises:
            FormatError: it is malformed.
        """
        self.index = index
        self.centre = settings.region_centre(index)
        self._settings = settings
        self._head = head
        shifts = {level: square_shift(settings, level) for level in settings.levels}
        self.engine = RegionField(settings, self._read({}), shifts)
        self.evidence = SeenBlocks(settings, cube_shift())

    def add(self, cells: Mapping[PartKey, bytes]) -> None:
        """Add squares of vertices and cubes of evidence, each once, by their keys.

        What is there already is neither read nor checked again.

        Raises:
            FormatError: a part is malformed; nothing was added.
        """
        region = self._read(cells)
        self.engine.add(region.tables)
        self.evidence.add(region.evidence)

    def _read(self, cells: Mapping[PartKey, bytes]) -> Region:
        """Return a region of these cells alone."""
        parts = RegionParts(self.index, self._settings)
        parts.add(PartKey(REGION, self.index), self._head)
        for key, payload in cells.items():
            parts.add(key, payload)
        region = parts.region()
        check_region(self._settings, region)
        return region
