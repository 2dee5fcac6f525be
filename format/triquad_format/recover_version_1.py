"""What is intact in a damaged map file of version 1.

There a part holds all the vertices of a plane and level: without one of them, no distance of its
region is right. So a region stays where all its vertices are intact.
"""

import dataclasses

from triquad_format.errors import FormatError, MapFileError
from triquad_format.mapfile.manifest import MAX_ENTRIES
from triquad_format.mapfile.map_facts import unpack_facts
from triquad_format.mapfile.mcap.records import Message
from triquad_format.mapfile.parts.part import (
    EVIDENCE,
    MANIFEST,
    MAP,
    REGION,
    REGION_TOPICS,
    TRAINING,
    TRAINING_TOPICS,
    VERTICES,
    PartKey,
)
from triquad_format.mapfile.parts.part_body import PartBody
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.record_check import check_record
from triquad_format.records.region import MapRecord, Region, RegionIndex
from triquad_format.recovery.recovery import Loss, Recovery, loss_of
from triquad_format.version_1 import PartCursor, unpack_region


def is_version_1(messages: list[Message]) -> bool:
    """Whether the parts are those of version 1: only there the first part counts the regions."""
    first = next((message for message in messages if message.topic == MAP), None)
    return first is not None and PartBody(MAP, first.data).has("regions")


def recover_version_1(messages: list[Message]) -> Recovery:
    """The regions of which all vertices are intact.

    Raises:
        MapFileError: the first part is malformed.
    """
    facts = unpack_facts(PartBody(MAP, next(m.data for m in messages if m.topic == MAP)))
    by_region: dict[RegionIndex, list[Message]] = {}
    for message in messages:
        if message.topic in REGION_TOPICS:
            index = PartBody(message.topic, message.data).index()
            by_region.setdefault(index, []).append(message)
    regions: list[Region] = []
    losses: list[Loss] = []
    for index, parts in by_region.items():
        region = _region(parts, facts.settings)
        losses += _losses(index, parts, region, facts.settings)
        if region is not None:
            regions.append(region)
    record = MapRecord(facts.name, facts.epoch, facts.settings, tuple(regions))
    intact = sum(len(parts) for parts in by_region.values())
    return Recovery(record, tuple(losses), intact, _listed(messages))


def _region(parts: list[Message], settings: FieldSettings) -> Region | None:
    """The region with as much of evidence and training state as is complete."""
    for evidence, training in ((True, True), (True, False), (False, True), (False, False)):
        topics = {REGION, VERTICES}
        topics |= {EVIDENCE} if evidence else set()
        topics |= set(TRAINING_TOPICS) if training else set()
        cursor = PartCursor(part for part in parts if part.topic in topics)
        try:
            region = unpack_region(cursor, settings, evidence=evidence, training=training)
            check_record(MapRecord("recovered", 0, settings, (region,)))
        except FormatError:
            continue
        return region
    return None


def _losses(
    index: RegionIndex, parts: list[Message], region: Region | None, settings: FieldSettings
) -> list[Loss]:
    """What a region has lost; evidence is lost as a whole."""
    whole = loss_of(PartKey(REGION, index), settings)
    if region is None:
        return [whole]
    head = PartBody(REGION, next(part.data for part in parts if part.topic == REGION))
    losses = []
    if len(region.evidence.codes) < head.count("blocks"):
        losses.append(dataclasses.replace(whole, key=PartKey(EVIDENCE, index)))
    if head.value("training", bool) and region.training is None:
        losses.append(dataclasses.replace(whole, key=PartKey(TRAINING, index)))
    return losses


def _listed(messages: list[Message]) -> int | None:
    """Parts of regions in the manifest, if that is intact."""
    for message in messages:
        if message.topic == MANIFEST:
            try:
                parts = PartBody(MANIFEST, message.data, MAX_ENTRIES).value("parts", list)
                return sum(part["topic"] in REGION_TOPICS for part in parts)
            except (MapFileError, TypeError, KeyError):
                return None
    return None
