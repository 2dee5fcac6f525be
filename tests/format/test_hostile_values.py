"""Files whose checksums and digests are all right, but whose values are not: each is refused."""

import dataclasses
import re
from typing import Any

import numpy as np
import pytest
from support.files.mapfile_edit import (
    Edit,
    all_of,
    assert_refused,
    edited,
    file_bytes,
    first_level,
    parts_of,
    read_bytes,
    rewritten,
    set_array,
    set_field,
    shorten,
    stored,
)
from support.maps.map_records import random_record, with_integers, with_rays, with_support
from triquad_format.errors import DamagedMapFileError, FormatError, MapFileError
from triquad_format.mapfile.manifest import Manifest
from triquad_format.mapfile.parts.part import (
    EVIDENCE,
    MANIFEST,
    MAP,
    MOMENTS,
    RAYS,
    REGION,
    SAMPLES,
    TRAINING,
    VERTICES,
)

RECORD = with_rays(with_support(random_record(12)))
DATA = file_bytes(RECORD)
POINT = np.array([[1.0, 1.0, 1.0]])


def nan_features(body: dict[str, Any]) -> None:
    data = bytearray(body["features"]["data"])
    half = len(data) // 2
    data[0], data[half] = 0x00, 0x7C
    body["features"]["data"] = bytes(data)


def lengthen(body: dict[str, Any]) -> None:
    body["features"]["shape"][1] += 1


def too_far(codes: tuple[int, int]) -> Edit:
    return set_array("codes", np.full(codes, 255, np.uint8))


ASTRONOMIC = {"dtype": "|u1", "shape": [0, 2**39, 2**39], "data": b""}

HOSTILE: dict[str, tuple[str, Edit]] = {
    "map: no version": (MAP, lambda b: b.pop("min_reader_version")),
    "training: too many steps": (TRAINING, set_field("mlp_steps", 2**31)),
    "map: epoch": (MAP, set_field("epoch", -1)),
    "map: another epoch": (MAP, set_field("epoch", 8)),
    "map: name": (MAP, set_field("name", "../etc")),
    "map: no settings": (MAP, lambda b: b.pop("settings")),
    "map: a setting of another type": (MAP, lambda b: b["settings"].update(depth=6.0)),
    "map: a setting out of range": (MAP, lambda b: b["settings"].update(depth=40)),
    "manifest: settings of other shapes": (MANIFEST, lambda b: b["settings"].update(hidden=6)),
    "region: index too large": (REGION, set_field("region", [2**40, 0, 0])),
    "region: weights": (REGION, set_field("weights", [])),
    "region: frequencies": (REGION, set_array("frequencies", np.full(4, np.inf, "<f4"))),
    "region: scales of features that are floats": (REGION, set_array("scales", np.ones(6, "<f4"))),
    "vertices: plane": (VERTICES, set_field("plane", 2)),
    "vertices: cell": (VERTICES, set_field("cell", 1)),
    "vertices: shape beyond the data": (VERTICES, first_level(lengthen)),
    "vertices: NaN": (VERTICES, first_level(nan_features)),
    "vertices: a code less": (VERTICES, first_level(shorten("codes", 1))),
    "vertices: of astronomic size": (VERTICES, first_level(set_field("features", ASTRONOMIC))),
    "vertices: integers without scales": (
        VERTICES,
        first_level(set_array("integers", np.ones((1, 3, 9), np.int8))),
    ),
    "vertices: equal codes": (
        VERTICES,
        first_level(set_array("codes", np.zeros((1, 9), np.uint8))),
    ),
    "vertices: codes outside": (VERTICES, first_level(too_far((6, 3)))),
    "evidence: blocks outside": (EVIDENCE, too_far((2, 3))),
    "evidence: a mask less": (EVIDENCE, shorten("free", 0)),
    "training: samples": (TRAINING, set_field("samples", 2**62)),
    "training: steps": (TRAINING, set_field("mlp_steps", -1)),
    "moments: a row less": (MOMENTS, first_level(shorten("steps", 1))),
    "moments: negative variance": (
        MOMENTS,
        first_level(lambda b: b["variances"].update(data=b"\xbf" * len(b["variances"]["data"]))),
    ),
    "samples: a sample less": (SAMPLES, all_of(shorten("points", 1), shorten("labels", 1))),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_values(case: str) -> None:
    assert_refused(edited(DATA, *HOSTILE[case]))


@pytest.mark.parametrize("part", [MAP, MANIFEST])
def test_other_frames_and_units_need_another_reader(part: str) -> None:
    for key in ("frame_id", "units"):
        with pytest.raises(MapFileError, match=f"{key} = 'x', not"):
            read_bytes(edited(DATA, part, set_field(key, "x")))


HOSTILE_INTEGERS: dict[str, Edit] = {
    "more than one byte and one": set_array("integers", np.zeros((3, 3, 9), np.int8)),
    "narrower": shorten("integers", 1),
    "floats": lambda b: b.pop("integers") and set_array("features", np.zeros((2, 9, 3), "u1"))(b),
}


@pytest.mark.parametrize("case", HOSTILE_INTEGERS)
def test_hostile_integers(case: str) -> None:
    edit = first_level(HOSTILE_INTEGERS[case])
    assert_refused(edited(file_bytes(with_integers(random_record(12))), VERTICES, edit))


def first_byte(key: str, value: int) -> Edit:
    """Replace the first byte of an array."""

    def edit(body: dict[str, Any]) -> None:
        body[key]["data"] = bytes([value]) + body[key]["data"][1:]

    return edit


HOSTILE_AND_TOLD: dict[str, tuple[str, Edit, str]] = {
    "levels of fewer voxels": (EVIDENCE, shorten("levels", 1), "levels: expected an array [3, 5]"),
    "levels of astronomic size": (EVIDENCE, set_field("levels", ASTRONOMIC), "levels: shape"),
    "times of fewer blocks": (EVIDENCE, shorten("seen_s", 1), "seen_s: expected an array"),
    "times after nothing": (
        EVIDENCE,
        lambda b: b.pop("seen_from_s"),
        "seen_from_s = None is not int",
    ),
    "times before 1970": (EVIDENCE, set_field("seen_from_s", -400), "-400 is not a count"),
    "times that pass the end": (
        EVIDENCE,
        set_field("seen_from_s", 9_223_372_036),
        "time lies outside",
    ),
    "outcomes of fewer voxels": (
        EVIDENCE,
        shorten("outcomes", 1),
        "outcomes: expected an array [10, 5]",
    ),
    "no rays announced": (TRAINING, lambda b: b.pop("rays"), "rays = None"),
    "no origins": (TRAINING, set_array("origins", np.zeros((0, 3), "<f4")), "not among"),
    "an end outside its leaf": (RAYS, first_byte("inside", 128), "outside its leaf"),
    "a leaf without rays": (RAYS, first_byte("counts", 0), "out of range"),
    "more rays in a leaf than ends": (RAYS, first_byte("counts", 255), "inside"),
    "an origin less": (RAYS, shorten("origins", 1), "origins"),
}


@pytest.mark.parametrize("case", HOSTILE_AND_TOLD)
def test_hostile_values_are_refused_with_what_is_wrong(case: str) -> None:
    topic, edit, message = HOSTILE_AND_TOLD[case]
    assert_refused(edited(DATA, topic, edit), re.escape(message))


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xc1",
        b"\x90",
        b"\xdf\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
        b"\x91" * 100_000,
        b"\x80\x80",
        b"\x81\xa4name\xd6\xff\x00\x00\x00\x00",
    ],
)
def test_hostile_msgpack(payload: bytes) -> None:
    for number in (0, 1):
        assert_refused(rewritten(DATA, payloads={number: payload}))
    assert_refused(rewritten(DATA, manifest_payload=lambda _: payload))


def test_a_query_does_not_forget_that_a_part_is_refused() -> None:
    with stored(edited(DATA, EVIDENCE, too_far((2, 3)))) as map_file:
        for _ in range(2):
            with pytest.raises(FormatError, match="evidence"):
                map_file.box(POINT[0] - 1, POINT[0] + 1)


@pytest.mark.parametrize(
    "progress",
    [
        None,
        {},
        {"scans_taken": -1, "samples_trained": 0, "loss": 0.0},
        {"scans_taken": 2**62, "samples_trained": 0, "loss": 0.0},
        {"scans_taken": 0, "samples_trained": 0, "loss": float("nan")},
    ],
)
def test_hostile_progress(progress: object) -> None:
    assert_refused(edited(DATA, MANIFEST, set_field("progress", progress)))


def column(name: str, number: int, value: int) -> Edit:
    """Another value in a column of the manifest."""

    def edit(body: dict[str, Any]) -> None:
        packed = body["parts"][name]
        array = np.frombuffer(packed["data"], packed["dtype"]).reshape(packed["shape"]).copy()
        array[number] = value
        packed["data"] = array.tobytes()

    return edit


HOSTILE_MANIFESTS: dict[str, Edit] = {
    "topic": column("topic", 1, 200),
    "plane": column("plane", 2, 3),
    "cell": column("cell", 2, -1),
    "size": column("bytes", 1, 2**62),
    "digest": column("sha256", 1, 0),
    "epoch": column("epoch", 1, -1),
    "a place behind the file": column("offset", 1, 2**62),
    "a place within another part": column("offset", 1, 200),
    "a long part": column("stored", 1, 2**40),
    "another region": column("region", 2, 9),
    "a column less": lambda b: b["parts"].pop("cell"),
    "a shorter column": lambda b: b["parts"].update(plane=b["parts"]["plane"] | {"shape": [1]}),
    "a topic that is no text": lambda b: b["topics"].__setitem__(0, 5),
    "time of creation": set_field("created_ns", -1),
    "another topic": set_field("topic", MAP),
}


@pytest.mark.parametrize("case", HOSTILE_MANIFESTS)
def test_hostile_manifests(case: str) -> None:
    assert_refused(edited(DATA, MANIFEST, HOSTILE_MANIFESTS[case]))


def test_parts_of_a_region_without_a_head() -> None:
    """Queries, boxes and whole reads must all mind that the region is not there."""

    def elsewhere(manifest: Manifest) -> Manifest:
        entry = manifest.entries[2]
        key = dataclasses.replace(entry.key, region=(9, 9, 9))
        moved = dataclasses.replace(entry, key=key)
        return dataclasses.replace(manifest, entries=(*manifest.entries, moved))

    mutant = rewritten(DATA, manifest=elsewhere)
    assert_refused(mutant, r"region of \(9, 9, 9\) is missing")
    with pytest.raises(DamagedMapFileError, match=r"region of \(9, 9, 9\) is missing"):
        stored(mutant)


@pytest.mark.parametrize("topic", [MAP, REGION, VERTICES, MOMENTS, SAMPLES, RAYS])
def test_parts_that_are_not_listed(topic: str) -> None:
    at = [part.topic for part in parts_of(DATA)].index(topic)

    def fewer(manifest: Manifest) -> Manifest:
        own = manifest.entries
        return dataclasses.replace(manifest, entries=(*own[:at], *own[at + 1 :]))

    assert_refused(rewritten(DATA, manifest=fewer))
