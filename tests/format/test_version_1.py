"""Files of version 1, which are no longer written: read as ever, and as strictly."""

import hashlib
from pathlib import Path

import msgpack
import numpy as np
import pytest
from support.map_records import assert_same, random_record
from support.mapfile_surgery import (
    RawPart,
    all_of,
    altered,
    metadata_of,
    parts_of,
    read_bytes,
    rebuild,
    set_array,
    set_field,
    shorten,
    sound_or_refused,
)
from triquad_format.errors import DamagedMapFileError, MapFileError
from triquad_format.mapfile.mapfile import read_map, read_map_file
from triquad_format.mapfile.parts.shuffle import shuffle_codes, unshuffle_codes
from triquad_format.wire.array import pack_array, unpack_array

GOLDEN = Path(__file__).parents[1] / "golden" / "map_v1.triquad"
DATA = GOLDEN.read_bytes()
RECORD = random_record(2024, indices=((0, 0, 0), (-1, 2, 0)), points=12, name="golden", epoch=42)


def listed(parts):
    """Parts with a manifest that fits them."""
    entries = [
        {"topic": p.topic, "bytes": len(p.payload), "sha256": hashlib.sha256(p.payload).digest()}
        for p in parts
    ]
    return [*parts, RawPart("/triquad/manifest", msgpack.packb({"parts": entries}))]


def file_of(parts):
    """A file of these parts, with a manifest and checksums that fit them."""
    return rebuild(listed(parts), metadata_of(DATA))


def part(topic, number=0):
    """Place of the ``number``-th part of a topic."""
    return [i for i, p in enumerate(parts_of(DATA)) if p.topic == topic][number]


def edited(topic, edit, number=0):
    parts = parts_of(DATA)[:-1]
    at = part(topic, number)
    body = msgpack.unpackb(parts[at].payload)
    edit(body)
    parts[at] = RawPart(topic, msgpack.packb(body))
    return file_of(parts)


def test_golden_file_reads_back(tmp_path):
    assert_same(read_map(GOLDEN), RECORD)
    assert_same(read_bytes(file_of(parts_of(DATA)[:-1])), RECORD)
    file = read_map_file(GOLDEN)
    assert file.manifest is None
    assert file.metadata["format_version"] == "1"
    assert [p.topic for p in file.parts] == [p.topic for p in parts_of(DATA)[:-1]]


def split(topic, at):
    """The golden parts with the first table of a topic in two parts, the first of ``at`` rows."""
    parts = parts_of(DATA)[:-1]
    place = part(topic)
    body = msgpack.unpackb(parts[place].payload)
    halves = []
    for rows in (slice(None, at), slice(at, None)):
        half = dict(body)
        for key, axis in _COLUMNS[topic].items():
            half[key] = pack_array(_rows(unpack_array(key, body[key]), rows, axis))
        if "codes" in body:
            codes = unshuffle_codes(unpack_array("codes", body["codes"]))
            half["codes"] = pack_array(shuffle_codes(codes[rows]))
        halves.append(RawPart(topic, msgpack.packb(half)))
    return parts[:place], halves, parts[place + 1 :]


def _rows(array, rows, axis):
    return np.ascontiguousarray(array[(slice(None),) * axis + (rows,)])


_COLUMNS = {
    "/triquad/vertices": {"features": 1},
    "/triquad/evidence": {"surface": 0, "free": 0},
    "/triquad/moments": {"means": 1, "variances": 1, "steps": 1},
    "/triquad/samples": {"points": 1, "labels": 1},
}


@pytest.mark.parametrize("topic", _COLUMNS)
def test_tables_in_several_parts(topic):
    before, halves, after = split(topic, 5)
    assert_same(read_bytes(file_of([*before, *halves, *after])), RECORD)
    wrongs = [halves[:1], [*halves, halves[1]], [halves[0], halves[0]]]
    if topic in ("/triquad/vertices", "/triquad/evidence"):  # their codes tell the order
        wrongs.append(halves[::-1])
    for wrong in wrongs:
        with pytest.raises(DamagedMapFileError):
            read_bytes(file_of([*before, *wrong, *after]))


def test_truncation_everywhere():
    for offset in {*range(200), *range(0, len(DATA), 37), *range(len(DATA) - 600, len(DATA))}:
        with pytest.raises(MapFileError):
            read_bytes(DATA[:offset])


def test_bit_flips():
    data = bytearray(DATA)
    rng = np.random.default_rng(0)
    head_and_tail = [*range(8 * 300), *range(8 * (len(data) - 300), 8 * len(data), 3)]
    for bit in [*head_and_tail[::3], *rng.integers(0, 8 * len(data), 1500)]:
        data[bit // 8] ^= 1 << bit % 8
        with pytest.raises(MapFileError):
            read_bytes(bytes(data))
        data[bit // 8] ^= 1 << bit % 8


def test_altered_parts_with_right_digests():
    mutants = altered(parts_of(DATA)[:-1], 250, np.random.default_rng(3))
    found = [sound_or_refused(read_bytes, file_of(mutant)) for mutant in mutants]
    assert 0 < sum(record is not None for record in found) < 250


def test_parts_missing_reordered_doubled_swapped():
    parts, metadata = parts_of(DATA), metadata_of(DATA)
    for i in range(len(parts)):
        mutants = [[*parts[:i], *parts[i + 1 :]], [*parts[: i + 1], *parts[i:]]]
        if i:
            mutants.append([*parts[: i - 1], parts[i], parts[i - 1], *parts[i + 1 :]])
        for mutant in mutants:
            with pytest.raises(DamagedMapFileError):
                read_bytes(rebuild(mutant, metadata))


def test_unknown_parts_are_skipped_but_checked():
    parts, extra = parts_of(DATA)[:-1], RawPart("/triquad/colours", b"anything")
    assert_same(read_bytes(file_of([*parts[:3], extra, *parts[3:], extra])), RECORD)
    with pytest.raises(DamagedMapFileError, match="colours"):
        read_bytes(rebuild([*parts[:3], extra, *parts[3:], parts_of(DATA)[-1]], metadata_of(DATA)))


HOSTILE = {
    "map: epoch": ("map", set_field("epoch", -1)),
    "map: regions": ("map", set_field("regions", 2**62)),
    "map: fewer regions": ("map", set_field("regions", 0)),
    "map: region count is a bool": ("map", set_field("regions", True)),
    "map: settings of other shapes": ("map", lambda b: b["settings"].update(hidden=6)),
    "region: other index": ("region", set_field("region", [5, 5, 5])),
    "region: no vertex counts": ("region", lambda b: b.pop("vertices")),
    "region: vertex counts": ("region", lambda b: b["vertices"].__setitem__(0, 2**62)),
    "region: too few vertex counts": ("region", lambda b: b["vertices"].pop()),
    "region: a vertex count is a bool": ("region", lambda b: b["vertices"].__setitem__(0, True)),
    "region: blocks": ("region", set_field("blocks", 0)),
    "region: frequencies": ("region", set_array("frequencies", np.full(4, np.inf, "<f4"))),
    "vertices: plane": ("vertices", set_field("plane", 2)),
    "vertices: level": ("vertices", set_field("level", 7)),
    "vertices: a code less": ("vertices", shorten("codes", 1)),
    "vertices: narrower": ("vertices", shorten("features", 2)),
    "vertices: equal codes": ("vertices", set_array("codes", np.zeros((1, 3), np.uint8))),
    "vertices: codes outside": ("vertices", set_array("codes", np.full((6, 3), 255, np.uint8))),
    "evidence: a mask less": ("evidence", shorten("free", 0)),
    "training: samples": ("training", set_field("samples", 2**62)),
    "training: fewer samples": ("training", set_field("samples", 1)),
    "moments: steps": ("moments", shorten("steps", 1)),
    "samples: a sample less": ("samples", all_of(shorten("points", 1), shorten("labels", 1))),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_values(case):
    topic, edit = HOSTILE[case]
    with pytest.raises(DamagedMapFileError):
        read_bytes(edited(f"/triquad/{topic}", edit))


def test_hostile_manifests():
    parts = parts_of(DATA)[:-1]
    for body in ({}, {"parts": [1]}, {"parts": [{"topic": "x"}]}, {"parts": []}):
        manifest = RawPart("/triquad/manifest", msgpack.packb(body))
        with pytest.raises(DamagedMapFileError):
            read_bytes(rebuild([*parts, manifest], metadata_of(DATA)))
