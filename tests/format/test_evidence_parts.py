"""Levels and outcomes of surface voxels and times of their blocks, wherever evidence goes."""

import dataclasses

import msgpack
import numpy as np
from support.files.checkpoint_folder import write_record
from support.files.mapfile_edit import file_bytes, parts_of, read_bytes, stored
from support.maps.map_records import (
    SMALL,
    assert_same,
    evidence_of,
    random_record,
    with_evidence,
    with_region,
    with_support,
)
from triquad_format.mapfile.parts.part import EVIDENCE
from triquad_format.mapfile.reader import read_map
from triquad_format.records.region import seen_voxels
from triquad_map.evidence.observations import outcome_codes
from triquad_tools.mapfiles.crop import crop_record

CUBES = dataclasses.replace(SMALL, depth=9)
"""Two cubes to a side."""

RECORD = with_support(random_record(21, settings=CUBES, indices=((0, 0, 0), (1, 0, 0)), points=500))


RANDOM = random_record(3, training=False)


def told_of(evidence):
    """Level, outcome and time of each surface voxel; blocks without surface have no time."""
    counts = np.unpackbits(evidence.surface, axis=1).sum(axis=1, dtype=np.int64)
    assert not evidence.seen_s[counts == 0].any()
    voxels = seen_voxels(evidence, evidence.surface)
    times = np.repeat(evidence.seen_s, counts)
    rows = np.column_stack([voxels, evidence.levels, evidence.outcomes, times])
    return set(map(tuple, rows.tolist()))


def test_literal_bytes():
    """The examples of the specification."""
    surface = np.zeros((3, 64), np.uint8)
    surface[0, 0], surface[2, 63] = 0b1011, 0b1
    levels = np.array([0, 3, 4, 6], np.uint8)
    seen_s = np.array([1_700_000_300, 0, 1_700_000_000], np.int64)
    evidence = dataclasses.replace(
        evidence_of(np.arange(3), surface, surface), levels=levels, seen_s=seen_s
    )
    data = file_bytes(with_region(RANDOM, evidence=evidence))
    (part,) = (part for part in parts_of(data) if part.topic == EVIDENCE)
    body = msgpack.unpackb(part.payload)
    assert body["levels"] == {"dtype": "|u1", "shape": [3, 1], "data": b"\x0c\x06\x08"}
    assert body["seen_from_s"] == 1_699_999_999
    assert body["seen_s"] == {"dtype": "|u1", "shape": [2, 2], "data": b"\x2d\x01\x01\x00"}


def test_literal_bytes_of_outcomes():
    """The example of the specification, from counts to bytes."""
    surface = np.zeros((1, 64), np.uint8)
    surface[0, 7] = 0b111
    counts = np.array([[120, 0, 0], [40, 330, 75], [1, 0, 0]], np.int32)
    evidence = dataclasses.replace(
        evidence_of(np.arange(1), surface, surface), outcomes=outcome_codes(counts)
    )
    assert evidence.outcomes.tolist() == [[0, 0, 0], [0, 7, 5], [1, 0, 0]]
    data = file_bytes(with_region(RANDOM, evidence=evidence))
    (part,) = (part for part in parts_of(data) if part.topic == EVIDENCE)
    planes = b"\x00\x04\x00\x02\x00\x00\x00\x02\x02\x02"
    stored = {"dtype": "|u1", "shape": [10, 1], "data": planes}
    assert msgpack.unpackb(part.payload)["outcomes"] == stored


def test_a_crop_keeps_the_levels_of_what_it_keeps():
    cropped = crop_record(RECORD, (-20, -30, -25), (100, 30, 20))
    for some, whole in zip(cropped.regions, RECORD.regions, strict=True):
        assert set() < told_of(some.evidence) < told_of(whole.evidence)
    assert_same(read_bytes(file_bytes(cropped)), cropped)
    with stored(file_bytes(RECORD)) as map_file:
        near = map_file.box((-20, -30, -25), (100, 30, 20))
    again = crop_record(near, (-20, -30, -25), (100, 30, 20))
    for one, other in zip(again.regions, cropped.regions, strict=True):
        assert_same(one.evidence, other.evidence)


def test_a_checkpoint_writes_the_cubes_whose_levels_changed(tmp_path):
    levels = RECORD.regions[0].evidence.levels.copy()
    levels[0] ^= 1
    following = with_evidence(dataclasses.replace(RECORD, epoch=8), levels=levels)
    known = {}
    write_record(tmp_path, RECORD, known=known)
    path = write_record(tmp_path, following, known=known)
    assert [entry.key.topic for entry in known.values() if entry.epoch == 8] == [EVIDENCE]
    assert_same(read_map(path), following)
