"""Files whose checksums and digests are all right, but whose values are not: each is refused."""

import dataclasses
import re
import struct
import tracemalloc
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
import pytest
import zstandard
from support.map_records import random_record, with_integers, with_rays, with_support
from support.mapfile_edit import (
    Edit,
    all_of,
    assert_refused,
    edited,
    file_bytes,
    in_level,
    parts_of,
    read_bytes,
    rewritten,
    set_array,
    set_field,
    shorten,
    stored,
    stored_record,
)
from triquad_format.errors import (
    DamagedMapFileError,
    FormatError,
    MapFileError,
    UnsupportedMapFileError,
)
from triquad_format.mapfile.container import chunk_messages
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
    PartKey,
)
from triquad_format.records.region import MapRecord

RECORD = with_rays(with_support(random_record(12)))
DATA = file_bytes(RECORD)
POINT = np.array([[1.0, 1.0, 1.0]])


def first_level(edit: Edit) -> Edit:
    return in_level(0, edit)


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
    "map: another topic": (MAP, set_field("topic", REGION)),
    "map: no version": (MAP, lambda b: b.pop("min_reader_version")),
    "map: another progress": (MAP, lambda b: b["progress"].update(scans_taken=1)),
    "region: another topic": (REGION, set_field("topic", VERTICES)),
    "training: places": (TRAINING, set_field("places_repaired", 2**31)),
    "training: places given up": (TRAINING, set_field("places_given_up", 2**31)),
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
def test_hostile_values(case: str) -> None:
    assert_refused(edited(DATA, *HOSTILE[case]))


@pytest.mark.parametrize("part", [MAP, MANIFEST])
def test_other_frames_and_units_need_another_reader(part: str) -> None:
    for key in ("frame_id", "units"):
        with pytest.raises(MapFileError, match=f"{key} = 'x', not"):
            read_bytes(edited(DATA, part, set_field(key, "x")))


HOSTILE_INTEGERS: dict[str, Edit] = {
    "more than one byte and one": set_array("integers", np.zeros((3, 3, 9), np.int8)),
    "no bytes": set_array("integers", np.zeros((0, 3, 9), np.int8)),
    "narrower": shorten("integers", 1),
    "a vertex less": shorten("integers", 2),
    "floats": lambda b: b.pop("integers") and set_array("features", np.zeros((2, 9, 3), "u1"))(b),
}


@pytest.mark.parametrize("case", HOSTILE_INTEGERS)
def test_hostile_integers(case: str) -> None:
    edit = first_level(HOSTILE_INTEGERS[case])
    assert_refused(edited(file_bytes(with_integers(random_record(12))), VERTICES, edit))


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf])
def test_hostile_scales(scale: float) -> None:
    edit = set_array("scales", np.full(6, scale, "<f4"))
    assert_refused(edited(file_bytes(with_integers(random_record(12))), REGION, edit))


HOSTILE_LEVELS: dict[str, tuple[Edit, str]] = {
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
def test_hostile_levels(case: str) -> None:
    edit, message = HOSTILE_LEVELS[case]
    assert_refused(edited(DATA, EVIDENCE, edit), re.escape(message))


def first_byte(key: str, value: int) -> Edit:
    """Replace the first byte of an array."""

    def edit(body: dict[str, Any]) -> None:
        body[key]["data"] = bytes([value]) + body[key]["data"][1:]

    return edit


HOSTILE_RAYS: dict[str, tuple[str, Edit, str]] = {
    "none announced": (TRAINING, lambda b: b.pop("rays"), "rays = None"),
    "fewer than announced": (TRAINING, set_field("rays", 10), "rays, not 10"),
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
def test_hostile_rays(case: str) -> None:
    topic, edit, message = HOSTILE_RAYS[case]
    assert_refused(edited(DATA, topic, edit), message)


@pytest.mark.parametrize("width", [0, 6, 8])
def test_times_of_other_widths(width: int) -> None:
    touched = int(RECORD.regions[0].evidence.surface.any(axis=1).sum())
    edit = set_array("seen_s", np.zeros((width, touched), np.uint8))
    assert_refused(edited(DATA, EVIDENCE, edit), f"seen_s has {width} bytes per time")


def test_integers_of_all_bytes_are_refused_above_the_limit() -> None:
    """Two bytes reach further than the integers that a writer may write."""

    def edit(body: dict[str, Any]) -> None:
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
def test_hostile_msgpack(payload: bytes) -> None:
    for number in (0, 1):
        assert_refused(rewritten(DATA, payloads={number: payload}))
    assert_refused(rewritten(DATA, manifest_payload=lambda _: payload))


def test_a_query_does_not_forget_that_a_part_is_refused() -> None:
    with stored(edited(DATA, EVIDENCE, too_far((2, 3)))) as map_file:
        for _ in range(2):
            with pytest.raises(FormatError, match="evidence"):
                map_file.query(POINT)


@pytest.mark.parametrize(
    "progress",
    [
        None,
        [60, 116_000_000, 0.25],
        {},
        {"scans_taken": -1, "samples_trained": 0, "loss": 0.0},
        {"scans_taken": True, "samples_trained": 0, "loss": 0.0},
        {"scans_taken": 2**62, "samples_trained": 0, "loss": 0.0},
        {"scans_taken": 0, "samples_trained": 2**62, "loss": 0.0},
        {"scans_taken": 0, "samples_trained": 0, "loss": float("nan")},
        {"scans_taken": 0, "samples_trained": 0, "loss": -0.5},
        {"scans_taken": 0, "samples_trained": 0, "loss": 1},
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
    "a cell that is not there": column("cell", 2, 2**60),
    "size": column("bytes", 1, 2**62),
    "a size less": column("bytes", 1, 100),
    "digest": column("sha256", 1, 0),
    "epoch": column("epoch", 1, -1),
    "a place before the file": column("offset", 1, -1),
    "a place behind the file": column("offset", 1, 2**62),
    "a place within another part": column("offset", 1, 200),
    "a long part": column("stored", 1, 2**40),
    "a part of nothing": column("stored", 1, 0),
    "another region": column("region", 2, 9),
    "a column less": lambda b: b["parts"].pop("cell"),
    "a column of another dtype": lambda b: b["parts"]["plane"].update(dtype="|i1"),
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


# Small files that unpack to much: they are refused before they take the memory


def many_entries(manifest: Manifest) -> Manifest:
    """More parts than the file has room to list."""
    entry = dataclasses.replace(manifest.entries[1], sha256=bytes(32))
    more = tuple(
        dataclasses.replace(entry, key=PartKey("/triquad/x", (0, 0, 0), 0, cell))
        for cell in range(50_000)
    )
    return dataclasses.replace(manifest, entries=(*manifest.entries, *more))


def one_place(manifest: Manifest) -> Manifest:
    """All parts of this size at one place."""
    own = [dataclasses.replace(entry, size=30 * 2**20) for entry in manifest.entries]
    return dataclasses.replace(manifest, entries=tuple(own))


def bomb(payload: bytes) -> Callable[[], bytes]:
    """A file with this payload as the head of its region."""
    return lambda: rewritten(DATA, payloads={1: payload})


def column_bomb(topic: str, edit: Edit) -> Callable[[], bytes]:
    return lambda: edited(DATA, topic, edit)


def ones(key: str, *shape: int) -> Edit:
    return set_array(key, np.ones(shape, np.uint8))


BOMBS: dict[str, Callable[[], bytes]] = {
    "rays": column_bomb(RAYS, set_array("counts", np.full((5, 1), 255, np.uint8))),
    "lists": bomb(msgpack.packb([[[[[]] * 60] * 60] * 60] * 60)),
    "texts": bomb(msgpack.packb([[["ab"] * 60] * 60] * 60)),
    "zeros": bomb(bytes(30 * 2**20)),
    "a manifest of zeros": lambda: rewritten(DATA, manifest_payload=lambda _: bytes(30 * 2**20)),
    "codes": column_bomb(VERTICES, first_level(ones("codes", 1, 11 * 2**20))),
    "levels": column_bomb(EVIDENCE, ones("levels", 3, 3 * 2**20)),
    "times": column_bomb(EVIDENCE, ones("seen_s", 1, 11 * 2**20)),
    "outcomes": column_bomb(EVIDENCE, ones("outcomes", 10, 2**20)),
    "parts": lambda: rewritten(DATA, manifest=many_entries),
    "sizes": lambda: rewritten(DATA, manifest=one_place),
}


@pytest.mark.parametrize("case", BOMBS)
@pytest.mark.parametrize("read", [read_bytes, stored_record])
def test_small_files_take_little_memory(case: str, read: Callable[[bytes], MapRecord]) -> None:
    mutant = BOMBS[case]()
    assert len(mutant) < 2**18
    tracemalloc.start()
    with pytest.raises(MapFileError):
        read(mutant)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 64 * 2**20 + len(mutant)


FRAME = zstandard.compress(bytes(50 * 2**20))
STREAMED = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(50 * 2**20))


@pytest.mark.parametrize(
    ("size", "stored_bytes", "message"),
    [
        (2**63, FRAME, "declares"),
        (50 * 2**20, FRAME, "declares"),
        (10, FRAME, "contradicts"),
        (1000, STREAMED, "cannot be read"),
        (1000, b"no zstd", "cannot be read"),
    ],
)
def test_chunks_that_declare_too_much(size: int, stored_bytes: bytes, message: str) -> None:
    head = struct.pack("<QQQII4sQ", 0, 0, size, 0, 4, b"zstd", len(stored_bytes))
    record = struct.pack("<BQ", 6, len(head) + len(stored_bytes)) + head + stored_bytes
    tracemalloc.start()
    with pytest.raises(DamagedMapFileError, match=message):
        chunk_messages(record, 0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


def test_other_compression_is_told() -> None:
    head = struct.pack("<QQQII3sQ", 0, 0, 9, 0, 3, b"lz4", 9) + bytes(9)
    with pytest.raises(UnsupportedMapFileError, match="lz4"):
        chunk_messages(struct.pack("<BQ", 6, len(head)) + head, 0)
