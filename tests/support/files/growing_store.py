"""Stores of a map of several regions, of which some change from checkpoint to checkpoint."""

import dataclasses
from functools import cache, partial

from support.maps.map_records import random_record
from triquad_format.mapfile.checkpoint_folder import PartFiles, checkpoint_files
from triquad_format.mapfile.reader import read_map_file
from triquad_format.mapfile.region_facts import RegionFacts
from triquad_format.records.field_settings import RegionIndex

ROW: tuple[RegionIndex, ...] = tuple((x, 0, 0) for x in range(6))


fresh_record = cache(partial(random_record, indices=ROW, name="lab", points=60))


def grown(seed, epoch, before=None, only=ROW):
    """A map of six regions; those not in ``only`` are as in ``before``."""
    fresh = dataclasses.replace(fresh_record(seed), epoch=epoch)
    if before is None:
        return fresh
    old = {region.index: region for region in before.regions}
    regions = tuple(r if r.index in only else old[r.index] for r in fresh.regions)
    return dataclasses.replace(fresh, regions=regions)


def changes(record, only=ROW):
    """What the mapper hands over where the regions ``only`` changed."""
    changed = tuple(region for region in record.regions if region.index in only)
    facts = {region.index: RegionFacts(1, 1, 0, 0, 0, 1000) for region in record.regions}
    return record.facts, changed, facts


def drive(store, epochs, rows=ROW):
    """Epochs of which each changes the next one of the regions ``rows``; the first all of them."""
    records = {1: grown(1, 1)}
    store.write(*changes(records[1]))
    for epoch in range(2, 2 + epochs):
        only = (rows[epoch % len(rows)],)
        record = grown(epoch, epoch, records[max(records)], only)
        store.write(*changes(record, only))
        records[epoch] = record
    return records


def paths(store):
    return {file.epoch: file.path for file in reversed(checkpoint_files(store.folder))}


def parts_of(path):
    """The files of the parts that a checkpoint names."""
    folder = PartFiles(path.parent).folder
    return {folder / entry.name for entry in read_map_file(path).manifest.entries}


def part_of(path, index, topic="/triquad/evidence"):
    """The file of one part of a region, as a checkpoint names it."""
    entries = read_map_file(path).manifest.entries
    chosen = next(e for e in entries if e.key.region == index and e.key.topic == topic)
    return PartFiles(path.parent).folder / chosen.name
