import dataclasses
import hashlib
import io
from collections import Counter
from pathlib import Path

import msgpack
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType
from support.map_records import (
    SMALL,
    assert_same,
    random_record,
    with_integers,
    with_levels,
    with_margins,
    with_outcomes,
    with_rays,
)
from support.mapfile_edit import (
    edited,
    file_bytes,
    manifest_of,
    metadata_of,
    parts_of,
    read_bytes,
    rebuild,
    stored,
    write_pair,
)
from triquad_format.errors import FormatError
from triquad_format.mapfile.metadata import MapFacts
from triquad_format.mapfile.parts.pack import pack_record
from triquad_format.mapfile.reader import read_map, read_map_file
from triquad_format.mapfile.writer import MapFileInfo, Previews, write_map, write_parts
from triquad_format.records import morton
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import AXES, MAX_INTEGER, MapRecord
from triquad_server.mesh.preview import preview_schema, previews_of

GOLDEN = Path(__file__).parents[1] / "golden"
GOLDEN_NAMES = ("map_v1.triquad", "map_v1_next.triquad")
GOLDEN_LEVELS = "map_v1_levels.triquad"
GOLDEN_OUTCOMES = "map_v1_outcomes.triquad"
GOLDEN_MARGINS = "map_v1_margins.triquad"
GOLDEN_RAYS = "map_v1_rays.triquad"
GOLDEN_PRODUCER = "0.1.0"
GOLDEN_ZSTD = (1, 5, 7)
"""The release of zstd that compressed the golden files: others may give other bytes."""


def golden_records():
    """The records of the golden files, and what follows; change them only with the version."""
    record = random_record(
        2024, indices=((0, 0, 0), (-1, 2, 0)), points=12, name="golden", epoch=42
    )
    one, other = record.regions
    (changed,) = with_integers(dataclasses.replace(record, regions=(other,)), 300).regions
    return record, dataclasses.replace(record, epoch=43, regions=(one, changed))


def golden_levels():
    """The record of the golden file with levels and times."""
    wide = dataclasses.replace(SMALL, depth=9)
    record = random_record(2025, settings=wide, points=40, training=False, name="golden", epoch=44)
    return with_levels(record)


def golden_outcomes():
    """The record of the golden file that has outcomes of rays besides."""
    return with_outcomes(golden_levels())


def golden_margins():
    """The record of the golden file that has margins of voxels besides."""
    return with_margins(golden_levels())


def golden_rays():
    """The record of the golden file with rays to train on."""
    return with_rays(random_record(2026, points=12, name="golden", epoch=45))


def write_golden(folder):
    """The golden files: a complete one, and what changed after it. None has a preview."""
    schema = preview_schema()
    stamps = (1_700_000_000 * 10**9, 1_700_000_060 * 10**9)
    write_pair(folder, *golden_records(), names=GOLDEN_NAMES, stamps=stamps, preview_schema=schema)
    previews = Previews(schema, {})
    write_map(golden_levels(), folder / GOLDEN_LEVELS, stamp_ns=stamps[0], previews=previews)
    write_map(golden_outcomes(), folder / GOLDEN_OUTCOMES, stamp_ns=stamps[0], previews=previews)
    write_map(golden_margins(), folder / GOLDEN_MARGINS, stamp_ns=stamps[0], previews=previews)
    write_map(golden_rays(), folder / GOLDEN_RAYS, stamp_ns=stamps[0], previews=previews)


# Round trips


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("dtype", ["<f2", "<f4"])
def test_round_trip(tmp_path, training, dtype):
    record = random_record(
        1, indices=((0, 0, 0), (3, -1, 2)), training=training, feature_dtype=dtype
    )
    path = tmp_path / "map.triquad"
    info = write_map(record, path, feature_dtype=dtype)
    assert_same(read_map(path), record)
    assert_same(read_map(str(path)), record)
    with path.open("rb") as stream:
        assert_same(read_map(stream), record)
    data = path.read_bytes()
    assert info == MapFileInfo(len(data), hashlib.sha256(data).hexdigest(), record.epoch)


@pytest.mark.parametrize(("limit", "planes"), [(1, 1), (127, 1), (128, 2), (MAX_INTEGER, 2)])
def test_integer_features(limit, planes):
    record = with_integers(random_record(2), limit)
    data = file_bytes(record)
    assert_same(read_bytes(data), record)
    bodies = [msgpack.unpackb(p.payload) for p in parts_of(data) if p.topic == "/triquad/vertices"]
    levels = [level for body in bodies for level in body["levels"]]
    assert {level["integers"]["shape"][0] for level in levels} == {planes}
    assert not any("features" in level for level in levels)


def test_regions_may_differ_in_their_features():
    base, record = golden_records()
    assert {table.scale is None for r in record.regions for table in r.tables} == {True, False}
    assert_same(read_bytes(file_bytes(record)), record)
    assert_same(read_bytes(file_bytes(base)), base)


def test_rays_of_a_cube_that_fill_several_parts(monkeypatch):
    monkeypatch.setattr("triquad_format.mapfile.parts.pack.RAYS_PER_PART", 80)
    record = with_rays(random_record(2))
    data = file_bytes(record)
    assert sum(part.topic == "/triquad/rays" for part in parts_of(data)) > 1
    assert_same(read_bytes(data), record)


def test_empty_map():
    record = MapRecord("default", 0, SMALL, ())
    assert_same(read_bytes(file_bytes(record)), record)
    assert_same(stored(file_bytes(record)).record(), record)


@pytest.mark.parametrize("preview", [True, False])
def test_regions_that_saw_nothing(preview):
    record = random_record(0, points=0)
    assert_same(read_bytes(file_bytes(record, preview=preview)), record)
    integers = with_integers(record)
    assert_same(read_bytes(file_bytes(integers, preview=preview)), integers)


@pytest.mark.parametrize("integers", [True, False])
def test_regions_are_split_into_squares_and_cubes(integers):
    record = random_record(2, settings=FieldSettings(), points=350)
    record = with_integers(record) if integers else record
    (region,) = record.regions
    places = {
        (table.plane, *cell)
        for table in region.tables
        for cell in (morton.decode(table.codes, 2) << (12 - table.level) >> 8).tolist()
    }
    cubes = np.unique(morton.decode(region.evidence.codes, 3) >> 5, axis=0)
    data = file_bytes(record)
    found = Counter(part.topic for part in parts_of(data))
    assert found["/triquad/vertices"] == found["/triquad/moments"] == len(places) > len(AXES)
    assert found["/triquad/evidence"] == len(cubes) > 1
    assert_same(read_bytes(data), record)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    points=st.integers(0, 30),
    encoding=st.sampled_from(["both", "features", "fourier"]),
    depth=st.integers(6, 15),
    levels=st.integers(1, 4),
    size=st.integers(1, 9),
    training=st.booleans(),
    limit=st.none() | st.integers(1, MAX_INTEGER),
    epoch=st.integers(0, 2**63 - 1),
)
def test_round_trip_of_any_record(
    seed, points, encoding, depth, levels, size, training, limit, epoch
):
    chosen = dataclasses.replace(
        SMALL, encoding=encoding, depth=depth, feature_levels=levels, feature_size=size
    )
    record = random_record(seed, settings=chosen, points=points, training=training, epoch=epoch)
    record = record if limit is None else with_integers(record, limit, seed)
    data = file_bytes(record)
    assert_same(read_bytes(data), record)
    assert_same(stored(data).record(), record)


def test_features_are_rounded_to_the_file_dtype():
    record = random_record(3, feature_dtype="<f4")
    table = read_bytes(file_bytes(record)).regions[0].tables[0]
    assert table.features.dtype == np.float16
    np.testing.assert_array_equal(
        table.features, record.regions[0].tables[0].features.astype(np.float16)
    )


def test_same_record_same_bytes():
    assert file_bytes(random_record(4), preview=True) == file_bytes(random_record(4), preview=True)
    assert "created" not in metadata_of(file_bytes(random_record(4)))["triquad"]


def test_stamp():
    stamp_ns = 1_700_000_000_123_456_789
    stamped = file_bytes(random_record(4), stamp_ns=stamp_ns)
    assert metadata_of(stamped)["triquad"]["created"] == "2023-11-14T22:13:20Z"
    manifest = manifest_of(stamped)
    assert manifest.stamp_ns == stamp_ns
    assert {(entry.epoch, entry.stamp_ns) for entry in manifest.entries} == {(7, stamp_ns)}
    messages = make_reader(io.BytesIO(stamped)).iter_messages()
    assert {message.log_time for _, _, message in messages} == {stamp_ns}
    assert manifest_of(file_bytes(random_record(4))).stamp_ns == 0
    for bad in (-1, 2**63):
        with pytest.raises(FormatError, match="stamp_ns"):
            file_bytes(random_record(4), stamp_ns=bad)


def test_info_of_parts():
    record = random_record(5)
    data = file_bytes(record)
    file = read_map_file(io.BytesIO(data))
    assert file.size == len(data)
    assert file.metadata["frame_id"] == "map"
    assert [part.topic for part in file.parts] == [part.topic for part in parts_of(data)[:-1]]
    assert 0 < sum(part.stored_size for part in file.parts) < len(data)
    assert file.manifest == manifest_of(data)


# The golden files


def test_golden_files_read_back():
    base, record = golden_records()
    assert sum((GOLDEN / name).stat().st_size for name in GOLDEN_NAMES) <= 80_000
    assert_same(read_map(GOLDEN / GOLDEN_NAMES[0]), base)
    assert_same(read_map(GOLDEN / GOLDEN_NAMES[1]), record)
    assert_same(read_map(GOLDEN / GOLDEN_LEVELS), golden_levels())
    assert_same(read_map(GOLDEN / GOLDEN_OUTCOMES), golden_outcomes())
    assert_same(read_map(GOLDEN / GOLDEN_MARGINS), golden_margins())
    assert_same(read_map(GOLDEN / GOLDEN_RAYS), golden_rays())


@pytest.fixture
def golden_pairs(monkeypatch, tmp_path):
    """The golden files, and what the writer writes now, under the name that it had then."""
    monkeypatch.setattr("triquad_format.mapfile.metadata.__version__", GOLDEN_PRODUCER)
    write_golden(tmp_path)
    names = (*GOLDEN_NAMES, GOLDEN_LEVELS, GOLDEN_OUTCOMES, GOLDEN_MARGINS, GOLDEN_RAYS)
    return [((GOLDEN / name).read_bytes(), (tmp_path / name).read_bytes()) for name in names]


@pytest.mark.skipif(zstandard.ZSTD_VERSION != GOLDEN_ZSTD, reason="made with another zstd")
def test_golden_bytes_are_what_the_writer_writes(golden_pairs):
    for golden, now in golden_pairs:
        assert now == golden


def test_golden_parts_are_what_the_writer_writes(golden_pairs):
    """Compared before compression."""
    for golden, now in golden_pairs:
        assert parts_of(now) == parts_of(golden)
        assert metadata_of(now) == metadata_of(golden)


def test_a_delta_holds_only_what_changed(golden_pairs):
    base, following, *_ = (parts_of(golden) for golden, _ in golden_pairs)
    changed = {part.topic for part in following}
    assert changed == {"/triquad/map", "/triquad/region", "/triquad/vertices", "/triquad/manifest"}
    assert not {part.payload for part in base} & {part.payload for part in following}


# Other tools


def test_stock_reader_sees_an_ordinary_file():
    data = file_bytes(random_record(6), preview=True)
    reader = make_reader(io.BytesIO(data), validate_crcs=True)
    assert reader.get_header().profile == ""
    assert reader.get_header().library.startswith("triquad ")
    summary = reader.get_summary()
    assert summary.statistics.message_count == len(parts_of(data)) == len(summary.chunk_indexes)
    encodings = {c.topic: c.message_encoding for c in summary.channels.values()}
    assert encodings.pop("/preview/mesh") == "protobuf"
    assert set(encodings.values()) == {"msgpack"}
    assert {chunk.compression for chunk in summary.chunk_indexes} <= {"zstd", ""}
    assert parts_of(data)[-1].topic == "/triquad/manifest"


def test_a_file_without_previews_has_no_protobuf_in_it():
    summary = make_reader(io.BytesIO(file_bytes(random_record(6)))).get_summary()
    assert not summary.schemas
    assert {channel.message_encoding for channel in summary.channels.values()} == {"msgpack"}


def test_previews_are_written_with_their_schema_only():
    record = random_record(6)
    previews = previews_of(record)
    facts = MapFacts(record.name, record.epoch, record.settings)
    parts = pack_record(record, "<f2", previews.parts)
    with pytest.raises(FormatError, match="give preview_schema"):
        write_parts(io.BytesIO(), facts, parts)


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.NONE},
        {"chunk_size": 1 << 20},
        {"use_chunking": False},
        {"enable_crcs": False},
        {"use_summary_offsets": False},
    ],
)
def test_files_rewritten_by_other_tools_are_read(options):
    record = random_record(6)
    data = file_bytes(record, preview=True)
    assert_same(read_bytes(rebuild(parts_of(data), metadata_of(data), **options)), record)


def test_unknown_fields_are_skipped():
    data = edited(file_bytes(random_record(7)), "/triquad/region", lambda b: b.update(more=[1]))
    assert_same(read_bytes(data), random_record(7))
