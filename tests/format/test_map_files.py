"""Map files of every kind: what is written is read back, and other programs can open it."""

import dataclasses
import hashlib
import io
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from support.files import golden
from support.files.mapfile_edit import (
    edited,
    file_bytes,
    manifest_of,
    metadata_of,
    parts_of,
    read_bytes,
    stored_record,
)
from support.maps.map_records import (
    SMALL,
    assert_same,
    random_record,
    with_integers,
    with_rays,
    with_support,
)
from triquad_format.errors import FormatError
from triquad_format.mapfile.reader import read_map
from triquad_format.mapfile.writer import MapFileInfo, write_map
from triquad_format.records import morton
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import AXES, MAX_INTEGER, MapProgress, MapRecord


def assert_read_back(record: MapRecord, data: bytes | None = None) -> None:
    """Both ways of reading give the record."""
    data = file_bytes(record) if data is None else data
    assert_same(read_bytes(data), record)
    assert_same(stored_record(data), record)


def test_what_is_read_has_the_types_for_which_kernels_are_compiled() -> None:
    """Arrays that can be written to: for others each kernel would be compiled once more."""
    (region, *_) = read_bytes(file_bytes(random_record(1))).regions
    evidence, mlp = region.evidence, region.mlp
    seen = (evidence.surface, evidence.free, evidence.levels, evidence.margins)
    for array in (*seen, *mlp.weights, *mlp.biases):
        assert array.flags.writeable
        assert array.flags.c_contiguous


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("dtype", ["<f2", "<f4"])
def test_round_trip(tmp_path: Path, training: bool, dtype: str) -> None:
    record = with_support(
        random_record(1, indices=((0, 0, 0), (3, -1, 2)), training=training, feature_dtype=dtype)
    )
    path = tmp_path / "map.triquad"
    info = write_map(record, path, feature_dtype=dtype)
    assert_same(read_map(path), record)
    assert_same(read_map(str(path)), record)
    data = path.read_bytes()
    assert info == MapFileInfo(len(data), hashlib.sha256(data).hexdigest(), record.epoch)


def test_rays_of_a_cube_that_fill_several_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("triquad_format.mapfile.parts.pack.RAYS_PER_PART", 80)
    record = with_rays(random_record(2))
    data = file_bytes(record)
    assert sum(part.topic == "/triquad/rays" for part in parts_of(data)) > 1
    assert_read_back(record, data)


def test_empty_map() -> None:
    assert_read_back(MapRecord("default", 0, SMALL, ()))


@pytest.mark.parametrize("integers", [True, False])
def test_regions_are_split_into_squares_and_cubes(integers: bool) -> None:
    record = random_record(2, settings=FieldSettings(depth=12), points=350)
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


@settings(max_examples=40)
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
    progress=st.tuples(st.integers(0, 2**62 - 1), st.integers(0, 2**62 - 1), st.floats(0, 9)),
)
def test_round_trip_of_any_record(
    seed: int,
    points: int,
    encoding: str,
    depth: int,
    levels: int,
    size: int,
    training: bool,
    limit: int | None,
    epoch: int,
    progress: tuple[int, int, float],
) -> None:
    chosen = dataclasses.replace(
        SMALL, encoding=encoding, depth=depth, feature_levels=levels, feature_size=size
    )
    record = random_record(seed, settings=chosen, points=points, training=training, epoch=epoch)
    record = with_support(record if limit is None else with_integers(record, limit, seed))
    if training:
        record = dataclasses.replace(with_rays(record, points), progress=MapProgress(*progress))
    assert_read_back(record)


def test_same_record_same_bytes() -> None:
    assert file_bytes(random_record(4), preview=True) == file_bytes(random_record(4), preview=True)
    assert "created" not in metadata_of(file_bytes(random_record(4)))


def test_stamp() -> None:
    stamp_ns = 1_700_000_000_123_456_789
    stamped = file_bytes(random_record(4), stamp_ns=stamp_ns)
    assert metadata_of(stamped)["created"] == "2023-11-14T22:13:20Z"
    manifest = manifest_of(stamped)
    assert manifest.stamp_ns == stamp_ns
    assert {entry.epoch for entry in manifest.entries} == {7}
    messages = make_reader(io.BytesIO(stamped)).iter_messages()
    assert {message.log_time for _, _, message in messages} == {stamp_ns}
    assert manifest_of(file_bytes(random_record(4))).stamp_ns == 0
    for bad in (-1, 2**63):
        with pytest.raises(FormatError, match="stamp_ns"):
            file_bytes(random_record(4), stamp_ns=bad)


# The golden files


def test_golden_files_read_back() -> None:
    assert sum(path.stat().st_size for path in golden.FOLDER.iterdir()) <= 100_000
    for name, record in golden.golden_records().items():
        assert_same(read_map(golden.FOLDER / name), record)


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A folder with what the writer writes now, under the name that it had then."""
    monkeypatch.setattr("triquad_format.mapfile.metadata.PRODUCER", golden.PRODUCER)
    golden.write_golden(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", [golden.TRAINED, golden.PLAIN])
def test_golden_files_are_what_the_writer_writes(written: Path, name: str) -> None:
    now, then = (written / name).read_bytes(), (golden.FOLDER / name).read_bytes()
    if zstandard.ZSTD_VERSION == golden.ZSTD:
        assert now == then
    assert parts_of(now)[:-1] == parts_of(then)[:-1]
    assert metadata_of(now).keys() == metadata_of(then).keys()


# Other programs


def test_stock_reader_sees_an_ordinary_file() -> None:
    data = file_bytes(random_record(6), preview=True)
    reader = make_reader(io.BytesIO(data), validate_crcs=True)
    assert reader.get_header().profile == ""
    assert reader.get_header().library == "triquad"
    summary = reader.get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(parts_of(data)) == len(summary.chunk_indexes)
    encodings = {c.topic: c.message_encoding for c in summary.channels.values()}
    assert encodings.pop("/preview/mesh") == "protobuf"
    assert set(encodings.values()) == {"msgpack-zstd"}
    assert parts_of(data)[-1].topic == "/triquad/manifest"


def test_unknown_fields_are_skipped() -> None:
    data = edited(file_bytes(random_record(7)), "/triquad/region", lambda b: b.update(more=[1]))
    assert_read_back(random_record(7), data)
