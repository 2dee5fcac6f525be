"""How far a map has come, in its file: it goes on with the map, and readers may do without."""

import dataclasses
from pathlib import Path

import msgpack
import numpy as np
import pytest
from support import spec_reader
from support.map_records import assert_same, random_record, with_progress, with_rays
from support.mapfile_edit import (
    assert_refused,
    edited,
    file_bytes,
    parts_of,
    read_bytes,
    set_field,
    stored_record,
    write_pair,
)
from triquad_format.errors import DamagedMapFileError, FormatError
from triquad_format.mapfile.metadata import MapFacts, unpack_facts
from triquad_format.mapfile.parts.body import unpack_body
from triquad_format.mapfile.parts.part import MANIFEST, MAP, TRAINING
from triquad_format.mapfile.reader import read_map
from triquad_format.records.map_progress import MapProgress
from triquad_format.recovery.recovered_map import recover

GOLDEN = Path(__file__).parents[1] / "golden"
PROGRESS = MapProgress(scans_taken=60, samples_trained=116_000_000, loss=0.25)
BYTES = bytes.fromhex(
    "a870726f6772657373"  # "progress"
    "83"  # a map of three
    "ab7363616e735f74616b656e" "3c"  # "scans_taken": 60
    "af73616d706c65735f747261696e6564" "ce06ea0500"  # "samples_trained": 116000000
    "a46c6f7373" "cb3fd0000000000000"  # "loss": 0.25
)  # fmt: skip


RECORD = with_progress(with_rays(random_record(3)), PROGRESS)
DATA = file_bytes(RECORD)


def test_it_comes_back_however_the_file_is_read(tmp_path: Path) -> None:
    assert_same(read_bytes(DATA), RECORD)
    assert_same(stored_record(DATA), RECORD)
    path = tmp_path / "map.triquad"
    path.write_bytes(DATA)
    assert_same(recover(path).record, RECORD)


def test_it_is_stored_as_the_page_says() -> None:
    first, *_, last = parts_of(DATA)
    assert (first.topic, last.topic) == (MAP, MANIFEST)
    assert first.payload.endswith(BYTES)
    assert BYTES in last.payload


def test_a_damaged_file_has_it_from_either_end(tmp_path: Path) -> None:
    """Without a manifest, the part of the map tells it."""
    path = tmp_path / "cut.triquad"
    path.write_bytes(DATA[: DATA.index(b"/triquad/manifest", len(DATA) * 9 // 10)])
    assert recover(path).record.progress == PROGRESS


def test_a_file_that_does_not_tell_begins_at_zero() -> None:
    record = read_map(GOLDEN / "map_v1_rays.triquad")
    assert record.progress == MapProgress()
    for region in record.regions:
        training = region.training
        assert training is not None
        assert (training.places_repaired, training.places_given_up) == (0, 0)


def test_nothing_is_written_of_a_map_that_was_just_begun() -> None:
    """So that files of maps that do not tell it are what they always were."""
    data = file_bytes(random_record(3))
    for part in parts_of(data):
        if part.topic in (MAP, MANIFEST, TRAINING):
            told = msgpack.unpackb(part.payload).keys()
            assert not told & {"progress", "places_repaired", "places_given_up"}


def test_readers_may_skip_it(tmp_path: Path) -> None:
    path, plain = tmp_path / "map.triquad", tmp_path / "plain.triquad"
    path.write_bytes(DATA)
    plain.write_bytes(file_bytes(dataclasses.replace(RECORD, progress=MapProgress())))
    points = np.random.default_rng(0).uniform(-20, 20, (1000, 3))
    told, untold = spec_reader.load(path), spec_reader.load(plain)
    assert vars(told.settings) == vars(untold.settings)
    np.testing.assert_array_equal(told.status(points), untold.status(points))


def test_a_delta_tells_that_of_its_own_epoch(tmp_path: Path) -> None:
    later = dataclasses.replace(RECORD, epoch=8, progress=MapProgress(61, 117_000_000, 0.2))
    write_pair(tmp_path, RECORD, later)
    assert read_map(tmp_path / "next.triquad").progress == later.progress
    assert read_map(tmp_path / "base.triquad").progress == PROGRESS


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
def test_what_cannot_be_is_refused(progress: object) -> None:
    body = {**msgpack.unpackb(parts_of(DATA)[0].payload), "progress": progress}
    with pytest.raises(DamagedMapFileError):
        unpack_facts(unpack_body(MAP, msgpack.packb(body)))


def test_what_else_a_later_writer_tells_is_skipped() -> None:
    told = {**dataclasses.asdict(PROGRESS), "scans_merged": 7}
    body = {**msgpack.unpackb(parts_of(DATA)[0].payload), "progress": told}
    assert unpack_facts(unpack_body(MAP, msgpack.packb(body))) == MapFacts.of(RECORD)


@pytest.mark.parametrize(
    ("topic", "field", "value"),
    [(MAP, "progress", {"scans_taken": 1, "samples_trained": 0, "loss": 0.0})]
    + [(TRAINING, name, 2**31) for name in ("places_repaired", "places_given_up")],
)
def test_a_file_that_contradicts_itself_or_counts_too_far_is_refused(
    topic: str, field: str, value: object
) -> None:
    assert_refused(edited(DATA, topic, set_field(field, value)))


@pytest.mark.parametrize("progress", [MapProgress(-1), MapProgress(loss=float("inf"))])
def test_a_writer_refuses_what_a_reader_would(progress: MapProgress) -> None:
    with pytest.raises(FormatError, match=r"scans_taken = -1|loss = inf"):
        file_bytes(dataclasses.replace(RECORD, progress=progress))
