"""Files whose checksums and digests are all right, but whose values are not: each is refused."""

import re

import numpy as np
import pytest
from support.map_records import random_record, with_integers, with_outcomes, with_rays
from support.mapfile_edit import (
    RawPart,
    all_of,
    assert_refused,
    edited,
    file_bytes,
    in_level,
    listed,
    manifest_of,
    metadata_of,
    parts_of,
    read_bytes,
    rebuild,
    set_array,
    set_field,
    shorten,
    stored,
)
from triquad_format.errors import DamagedMapFileError, FormatError, MapFileError

DATA = file_bytes(random_record(12))
POINT = np.array([[1.0, 1.0, 1.0]])


def first_level(edit):
    return in_level(0, edit)


def nan_features(body):
    data = bytearray(body["features"]["data"])
    half = len(data) // 2
    data[0], data[half] = 0x00, 0x7C
    body["features"]["data"] = bytes(data)


def lengthen(body):
    body["features"]["shape"][1] += 1


def too_far(codes):
    return set_array("codes", np.full(codes, 255, np.uint8))


REGION, VERTICES, EVIDENCE = "/triquad/region", "/triquad/vertices", "/triquad/evidence"
MOMENTS, SAMPLES, TRAINING = "/triquad/moments", "/triquad/samples", "/triquad/training"
MAP, MANIFEST = "/triquad/map", "/triquad/manifest"
ASTRONOMIC = {"dtype": "|u1", "shape": [0, 2**39, 2**39], "data": b""}

HOSTILE = {
    "map: epoch": (MAP, set_field("epoch", -1)),
    "map: another epoch": (MAP, set_field("epoch", 8)),
    "map: name": (MAP, set_field("name", "../etc")),
    "map: no settings": (MAP, lambda b: b.pop("settings")),
    "map: a setting of another type": (MAP, lambda b: b["settings"].update(depth=6.0)),
    "map: a setting out of range": (MAP, lambda b: b["settings"].update(depth=40)),
    "map: a setting is NaN": (MAP, lambda b: b["settings"].update(leaf_m=float("nan"))),
    "map: huge integer": (MAP, lambda b: b["settings"].update(leaf_m=2**63)),
    "manifest: settings of other shapes": (MANIFEST, lambda b: b["settings"].update(hidden=6)),
    "manifest: settings of more tables": (MANIFEST, lambda b: b["settings"].update(depth=7)),
    "region: index": (REGION, set_field("region", [0, 0])),
    "region: index too large": (REGION, set_field("region", [2**40, 0, 0])),
    "region: other index": (REGION, set_field("region", [5, 5, 5])),
    "region: weights": (REGION, set_field("weights", [])),
    "region: weight": (REGION, lambda b: b["weights"].__setitem__(0, 7)),
    "region: frequencies": (REGION, set_array("frequencies", np.full(4, np.inf, "<f4"))),
    "region: frequencies of f8": (REGION, set_array("frequencies", np.ones(4))),
    "region: scales of features that are floats": (REGION, set_array("scales", np.ones(6, "<f4"))),
    "region: too few scales": (REGION, set_array("scales", np.ones(5, "<f4"))),
    "vertices: plane": (VERTICES, set_field("plane", 2)),
    "vertices: cell": (VERTICES, set_field("cell", 1)),
    "vertices: region": (VERTICES, set_field("region", [1, 0, 0])),
    "vertices: too few levels": (VERTICES, lambda b: b["levels"].pop()),
    "vertices: a level is no map": (VERTICES, lambda b: b["levels"].__setitem__(0, [])),
    "vertices: shape beyond the data": (VERTICES, first_level(lengthen)),
    "vertices: NaN": (VERTICES, first_level(nan_features)),
    "vertices: a vertex less": (
        VERTICES,
        first_level(all_of(shorten("codes", 1), shorten("features", 1))),
    ),
    "vertices: a code less": (VERTICES, first_level(shorten("codes", 1))),
    "vertices: narrower": (VERTICES, first_level(shorten("features", 2))),
    "vertices: no features": (VERTICES, first_level(lambda b: b.pop("features"))),
    "vertices: dtype is a list": (
        VERTICES,
        first_level(lambda b: b["features"].update(dtype=["<f2"])),
    ),
    "vertices: of astronomic size": (VERTICES, first_level(set_field("features", ASTRONOMIC))),
    "vertices: integers without scales": (
        VERTICES,
        first_level(set_array("integers", np.ones((1, 3, 9), np.int8))),
    ),
    "vertices: equal codes": (
        VERTICES,
        first_level(set_array("codes", np.zeros((1, 9), np.uint8))),
    ),
    "vertices: no bytes per code": (
        VERTICES,
        first_level(set_array("codes", np.zeros((0, 9), np.uint8))),
    ),
    "vertices: codes outside": (VERTICES, first_level(too_far((6, 3)))),
    "vertices: wide codes": (VERTICES, first_level(too_far((8, 3)))),
    "evidence: blocks outside": (EVIDENCE, too_far((2, 3))),
    "evidence: masks": (EVIDENCE, set_array("surface", np.zeros((1, 64), np.uint8))),
    "evidence: a mask less": (EVIDENCE, shorten("free", 0)),
    "training: samples": (TRAINING, set_field("samples", 2**62)),
    "training: fewer samples": (TRAINING, set_field("samples", 1)),
    "training: steps": (TRAINING, set_field("mlp_steps", -1)),
    "training: budget": (TRAINING, set_field("training_budget", 2**64 - 1)),
    "moments: steps": (MOMENTS, first_level(set_array("steps", np.zeros((4, 1), np.uint8)))),
    "moments: a row less": (MOMENTS, first_level(shorten("steps", 1))),
    "moments: negative variance": (
        MOMENTS,
        first_level(lambda b: b["variances"].update(data=b"\xbf" * len(b["variances"]["data"]))),
    ),
    "samples: labels": (SAMPLES, set_array("labels", np.zeros((2, 1), np.uint8))),
    "samples: a sample less": (SAMPLES, all_of(shorten("points", 1), shorten("labels", 1))),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_values(case):
    assert_refused(edited(DATA, *HOSTILE[case]))


@pytest.mark.parametrize("part", [MAP, MANIFEST])
def test_other_frames_and_units_need_another_reader(part):
    for key in ("frame_id", "units"):
        with pytest.raises(MapFileError, match=f"{key} = 'x', not"):
            read_bytes(edited(DATA, part, set_field(key, "x")))


HOSTILE_INTEGERS = {
    "more than one byte and one": set_array("integers", np.zeros((3, 3, 9), np.int8)),
    "no bytes": set_array("integers", np.zeros((0, 3, 9), np.int8)),
    "narrower": shorten("integers", 1),
    "a vertex less": shorten("integers", 2),
    "floats": lambda b: b.pop("integers") and set_array("features", np.zeros((2, 9, 3), "u1"))(b),
}


@pytest.mark.parametrize("case", HOSTILE_INTEGERS)
def test_hostile_integers(case):
    edit = first_level(HOSTILE_INTEGERS[case])
    assert_refused(edited(file_bytes(with_integers(random_record(12))), VERTICES, edit))


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf])
def test_hostile_scales(scale):
    edit = set_array("scales", np.full(6, scale, "<f4"))
    assert_refused(edited(file_bytes(with_integers(random_record(12))), REGION, edit))


HOSTILE_LEVELS = {
    "levels of fewer voxels": (shorten("levels", 1), "levels: expected an array [3, 5]"),
    "levels of two bits": (shorten("levels", 0), "levels: expected an array [3, 5]"),
    "a level a byte": (set_array("levels", np.ones(40, np.uint8)), "levels: expected an array"),
    "levels that are a number": (set_field("levels", 3), "levels: expected an array"),
    "levels of astronomic size": (set_field("levels", ASTRONOMIC), "levels: shape"),
    "times of fewer blocks": (shorten("seen_s", 1), "seen_s: expected an array"),
    "times of nothing": (set_field("seen_s", None), "seen_s: expected an array"),
    "times after nothing": (lambda b: b.pop("seen_from_s"), "seen_from_s = None is not int"),
    "times before 1970": (set_field("seen_from_s", -400), "seen_from_s = -400 is not a count"),
    "times beyond stamps": (set_field("seen_from_s", 9_223_372_037), "above 9223372036"),
    "times that pass the end": (set_field("seen_from_s", 9_223_372_036), "time lies outside"),
    "outcomes of fewer voxels": (shorten("outcomes", 1), "outcomes: expected an array [10, 5]"),
    "outcomes of nine planes": (shorten("outcomes", 0), "outcomes: expected an array [10, 5]"),
    "outcomes of wide planes": (
        set_array("outcomes", np.zeros((10, 5), "<i2")),
        "outcomes: expected an array",
    ),
    "outcomes of nothing": (set_field("outcomes", None), "outcomes: expected an array"),
    "outcomes of astronomic size": (set_field("outcomes", ASTRONOMIC), "outcomes: shape"),
}


@pytest.mark.parametrize("case", HOSTILE_LEVELS)
def test_hostile_levels(case):
    edit, message = HOSTILE_LEVELS[case]
    data = edited(file_bytes(with_outcomes(random_record(12))), EVIDENCE, edit)
    assert_refused(data)
    with pytest.raises(DamagedMapFileError, match=re.escape(message).replace(r"\|", "|")):
        read_bytes(data)


def first_byte(key, value):
    """Replace the first byte of an array."""

    def edit(body):
        body[key]["data"] = bytes([value]) + body[key]["data"][1:]

    return edit


RAYS = "/triquad/rays"
HOSTILE_RAYS = {
    "fewer than announced": (TRAINING, set_field("rays", 10), "rays, not 10"),
    "announced, and not there": (TRAINING, lambda b: b.pop("rays"), "rays, not 0"),
    "no origins": (TRAINING, set_array("origins", np.zeros((0, 3), "<f4")), "not among"),
    "origins that are not finite": (
        TRAINING,
        set_array("origins", np.full((300, 3), np.nan, "<f4")),
        "origins",
    ),
    "an end outside its leaf": (RAYS, first_byte("inside", 128), "outside its leaf"),
    "a leaf without rays": (RAYS, first_byte("counts", 0), "out of range"),
    "more rays in a leaf than ends": (RAYS, first_byte("counts", 255), "inside"),
    "a slope less": (RAYS, shorten("slopes", 0), "slopes"),
    "an origin less": (RAYS, shorten("origins", 1), "origins"),
    "no bytes of a count": (RAYS, set_array("counts", np.zeros((0, 1), "u1")), "counts"),
    "leaves of a cell that cannot be": (RAYS, too_far((4, 1)), "codes|counts|outside"),
}


@pytest.mark.parametrize("case", HOSTILE_RAYS)
def test_hostile_rays(case):
    topic, edit, message = HOSTILE_RAYS[case]
    data = edited(file_bytes(with_rays(random_record(12))), topic, edit)
    assert_refused(data)
    with pytest.raises(FormatError, match=message):
        read_bytes(data)


@pytest.mark.parametrize("width", [0, 6, 8])
def test_times_of_other_widths(width):
    record = with_outcomes(random_record(12))
    touched = int(record.regions[0].evidence.surface.any(axis=1).sum())
    edit = set_array("seen_s", np.zeros((width, touched), np.uint8))
    data = edited(file_bytes(record), EVIDENCE, edit)
    assert_refused(data)
    with pytest.raises(DamagedMapFileError, match=f"seen_s has {width} bytes per time"):
        read_bytes(data)


def test_integers_of_all_bytes_are_refused_above_the_limit():
    """Two bytes reach further than the integers that a writer may write."""

    def edit(body):
        body["integers"]["data"] = b"\x80" * len(body["integers"]["data"])

    record = with_integers(random_record(12), 300)
    assert_refused(edited(file_bytes(record), VERTICES, first_level(edit)))


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xc1",
        b"\x90",
        b"\xdf\xff\xff\xff\xff",
        b"\xdd\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
        b"\x91" * 100_000,
        b"\x81\x01\x02",
        b"\x81\xa1\xff\x01",
        b"\x80\x80",
        b"\x81\xa4name\xd6\xff\x00\x00\x00\x00",
    ],
)
def test_hostile_msgpack(payload):
    data = file_bytes(random_record(13))
    parts, metadata, manifest = parts_of(data), metadata_of(data), manifest_of(data)
    for at, topic in ((0, MAP), (1, REGION)):
        hostile = [*parts[:at], RawPart(topic, payload), *parts[at + 1 : -1]]
        assert_refused(rebuild(listed(hostile, manifest), metadata))
    assert_refused(rebuild([*parts[:-1], RawPart(MANIFEST, payload)], metadata))


def test_a_query_does_not_forget_that_a_part_is_refused():
    mutant = edited(DATA, EVIDENCE, too_far((2, 3)))
    with stored(mutant) as map_file:
        for _ in range(2):
            with pytest.raises(FormatError, match="evidence"):
                map_file.query(POINT)
