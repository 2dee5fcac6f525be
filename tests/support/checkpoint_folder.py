"""Folders of checkpoints of a map of two regions, as a server leaves them."""

import dataclasses
from pathlib import Path

from support.map_records import random_record
from triquad_format.mapfile.checkpoint_folder import checkpoint_name
from triquad_format.mapfile.manifest import Entry
from triquad_format.mapfile.metadata import MapFacts
from triquad_format.mapfile.parts.pack import pack_record
from triquad_format.mapfile.parts.part import PartKey
from triquad_format.mapfile.writer import write_parts
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
    """A complete checkpoint, then deltas, an hour apart; their files."""
    known: dict[PartKey, Entry] = {}
    paths = []
    for hours, epoch in enumerate(epochs):
        record = map_at(epoch)
        stamp_ns = START_NS + hours * HOUR_NS
        path = folder / checkpoint_name(epoch, complete=not known)
        facts = MapFacts.of(record)
        parts = pack_record(record, "<f2", {})
        written = write_parts(path, facts, parts, stamp_ns=stamp_ns, known=known)
        known = written.manifest.elsewhere(path.name)
        paths.append(path)
    return paths
