"""Folders of checkpoints of a map of two regions, as a server leaves them."""

import dataclasses
from pathlib import Path

from support.maps.map_records import random_record
from triquad_format.mapfile.checkpoint_folder import NewParts, checkpoint_name
from triquad_format.mapfile.index import Checkpoint, write_checkpoint
from triquad_format.mapfile.manifest import Entry, Manifest
from triquad_format.mapfile.parts.pack import pack_record
from triquad_format.mapfile.parts.part import PartKey
from triquad_format.records.region import MapRecord

START_NS = 1_769_860_800 * 10**9  # 2026-01-31T12:00:00Z
HOUR_NS = 3600 * 10**9
FIRST, SECOND = (0, 0, 0), (-1, 0, 0)


def map_at(epoch: int) -> MapRecord:
    """The map, of which only the second region changes from epoch to epoch."""
    still = random_record(1, indices=(FIRST,)).regions
    changing = random_record(epoch, indices=(SECOND,)).regions
    return dataclasses.replace(random_record(1), epoch=epoch, regions=(*still, *changing))


def write_checkpoints(folder: Path, epochs: tuple[int, ...]) -> list[Path]:
    """Checkpoints, an hour apart; their files."""
    known: dict[PartKey, Entry] = {}
    paths = []
    for hours, epoch in enumerate(epochs):
        paths.append(write_record(folder, map_at(epoch), START_NS + hours * HOUR_NS, known))
    return paths


def write_record(
    folder: Path,
    record: MapRecord,
    stamp_ns: int = START_NS,
    known: dict[PartKey, Entry] | None = None,
    undoes: str = "",
) -> Path:
    """A checkpoint of a map; its file. ``known`` are the parts of the one before, and of this."""
    known = {} if known is None else known
    new = NewParts(folder, record.epoch)
    entries = [new.add(part, known.get(part.key)) for part in pack_record(record, "<f2", {})]
    new.commit()
    known.update({entry.key: entry for entry in entries})
    path = folder / checkpoint_name(record.epoch)
    manifest = Manifest(record.facts, stamp_ns, tuple(entries))
    write_checkpoint(path, Checkpoint(manifest, undoes))
    return path
