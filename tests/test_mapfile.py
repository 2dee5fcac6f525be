import contextlib
import dataclasses
import hashlib
import io
import math
import os
import struct
import zlib
from collections import Counter
from pathlib import Path

import msgpack
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from map_records import SMALL, assert_same, random_record
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from triquad_format import map_parts, mapfile_reader
from triquad_format.array import pack_array, unpack_array
from triquad_format.errors import (
    DamagedMapFileError,
    FormatError,
    MapFileError,
    TooLargeMapFileError,
    UnsupportedMapFileError,
)
from triquad_format.field_settings import FieldSettings
from triquad_format.map_parts import (
    MAX_CODE_BYTES,
    ROWS_PER_PART,
    Part,
    pack_manifest,
    shuffle,
    shuffle_codes,
    unshuffle,
    unshuffle_codes,
)
from triquad_format.mapfile import MapFileInfo, read_map, read_map_file, write_map
from triquad_format.mapfile_writer import MAX_PART_BYTES
from triquad_format.mcap_records import MAX_CHUNK_BYTES
from triquad_format.region import BLOCK_BYTES, MapRecord

GOLDEN = Path(__file__).parent / "golden" / "map_v1.triquad"


def golden_record():
    """The record of the golden file; change it only with the format's version."""
    return random_record(2024, indices=((0, 0, 0), (-1, 2, 0)), points=12, name="golden", epoch=42)


def file_bytes(record, **options):
    stream = io.BytesIO()
    write_map(record, stream, **options)
    return stream.getvalue()


def read_bytes(data):
    return read_map(io.BytesIO(data))


def parts_of(data):
    """The parts of a file by the stock reader, which also checks the CRCs it knows."""
    reader = make_reader(io.BytesIO(data), validate_crcs=True)
    return [
        Part(channel.topic, message.data)
        for _, channel, message in reader.iter_messages(log_time_order=False)
    ]


def metadata_of(data):
    return {m.name: m.metadata for m in make_reader(io.BytesIO(data)).iter_metadata()}


def rebuild(parts, metadata, *, encoding="msgpack", **options):
    """An MCAP file with right CRCs around whatever parts are given."""
    stream = io.BytesIO()
    writer = Writer(stream, enable_data_crcs=True, **options)
    writer.start()
    for name, entries in metadata.items():
        writer.add_metadata(name, entries)
    channels = {}
    for part in parts:
        if part.topic not in channels:
            channels[part.topic] = writer.register_channel(part.topic, encoding, 0)
        writer.add_message(channels[part.topic], 0, part.payload, 0)
    writer.finish()
    return stream.getvalue()


def listed(parts):
    """Parts with a manifest that fits them."""
    return [
        *parts,
        pack_manifest(
            [(p.topic, len(p.payload), hashlib.sha256(p.payload).digest()) for p in parts]
        ),
    ]


def edited(data, topic, edit, number=0):
    """The file with the ``number``-th part of a topic changed by ``edit``; digests fit."""
    parts = parts_of(data)[:-1]
    at = [i for i, part in enumerate(parts) if part.topic == topic][number]
    body = msgpack.unpackb(parts[at].payload)
    edit(body)
    parts[at] = Part(topic, msgpack.packb(body))
    return rebuild(listed(parts), metadata_of(data))


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


def test_empty_map():
    record = MapRecord("default", 0, SMALL, ())
    assert_same(read_bytes(file_bytes(record)), record)


def test_regions_that_saw_nothing():
    record = random_record(0, points=0)
    assert_same(read_bytes(file_bytes(record)), record)


@pytest.mark.parametrize("dtype", ["<f2", "<f4"])
def test_tables_larger_than_a_part_are_split(monkeypatch, dtype):
    monkeypatch.setattr(map_parts, "ROWS_PER_PART", 100)
    record = random_record(2, settings=FieldSettings(), points=350, feature_dtype=dtype)
    data = file_bytes(record, feature_dtype=dtype)
    (region,) = record.regions
    tables = sum(math.ceil(len(table.codes) / 100) for table in region.tables)
    blocks = math.ceil(len(region.evidence.codes) / 100)
    found = Counter(part.topic for part in parts_of(data))
    assert tables > len(region.tables)
    assert blocks > 1
    assert found["/triquad/vertices"] == found["/triquad/moments"] == tables
    assert found["/triquad/evidence"] == blocks
    assert found["/triquad/samples"] == 4
    assert_same(read_bytes(data), record)


def test_parts_of_the_widest_rows_keep_the_limit():
    widest = FieldSettings(feature_size=64)
    row = np.zeros((1, widest.feature_size), "<f4")
    assert ROWS_PER_PART * (2 * row.nbytes + 4) < MAX_PART_BYTES  # moments
    assert ROWS_PER_PART * (2 * BLOCK_BYTES + MAX_CODE_BYTES) < MAX_PART_BYTES  # evidence


def split_file(monkeypatch):
    monkeypatch.setattr(map_parts, "ROWS_PER_PART", 20)
    return file_bytes(random_record(21))


def set_shorter(key, axis):
    """Cut the last row off one column of a part."""

    def edit(body):
        planes = unpack_array(key, body[key])
        body[key] = pack_array(np.ascontiguousarray(np.delete(planes, -1, axis)))

    return edit


def all_of(*edits):
    return lambda body: [edit(body) for edit in edits]


@pytest.mark.parametrize(
    ("topic", "edit"),
    [
        ("/triquad/vertices", set_shorter("codes", 1)),
        ("/triquad/vertices", all_of(set_shorter("codes", 1), set_shorter("features", 1))),
        ("/triquad/vertices", set_shorter("features", 2)),
        ("/triquad/vertices", lambda b: b.update(level=6)),
        ("/triquad/moments", set_shorter("steps", 1)),
        ("/triquad/evidence", set_shorter("free", 0)),
        ("/triquad/samples", all_of(set_shorter("points", 1), set_shorter("labels", 1))),
    ],
)
def test_portions_that_do_not_fit_together_are_refused(monkeypatch, topic, edit):
    data = split_file(monkeypatch)
    assert_same(read_bytes(data), random_record(21))
    with pytest.raises(DamagedMapFileError):
        read_bytes(edited(data, topic, edit, number=1))


def test_codes_increase_over_all_portions_of_a_table(monkeypatch):
    data = split_file(monkeypatch)
    first = next(p for p in parts_of(data) if p.topic == "/triquad/vertices")
    codes = msgpack.unpackb(first.payload)["codes"]
    with pytest.raises(DamagedMapFileError, match="increasing"):
        read_bytes(edited(data, first.topic, lambda b: b.update(codes=codes), number=1))


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    points=st.integers(0, 30),
    encoding=st.sampled_from(["both", "features", "fourier"]),
    depth=st.integers(6, 15),
    levels=st.integers(1, 4),
    size=st.integers(1, 9),
    training=st.booleans(),
    epoch=st.integers(0, 2**63 - 1),
)
def test_round_trip_of_any_record(seed, points, encoding, depth, levels, size, training, epoch):
    chosen = dataclasses.replace(
        SMALL, encoding=encoding, depth=depth, feature_levels=levels, feature_size=size
    )
    record = random_record(seed, settings=chosen, points=points, training=training, epoch=epoch)
    assert_same(read_bytes(file_bytes(record)), record)


def test_features_are_rounded_to_the_file_dtype():
    record = random_record(3, feature_dtype="<f4")
    table = read_bytes(file_bytes(record)).regions[0].tables[0]
    assert table.features.dtype == np.float16
    np.testing.assert_array_equal(
        table.features, record.regions[0].tables[0].features.astype(np.float16)
    )


def test_same_record_same_bytes():
    record = random_record(4)
    assert file_bytes(record) == file_bytes(random_record(4))
    assert "created" not in metadata_of(file_bytes(record))["triquad"]


def test_stamp():
    stamped = file_bytes(random_record(4), stamp_ns=1_700_000_000_123_456_789)
    assert metadata_of(stamped)["triquad"]["created"] == "2023-11-14T22:13:20Z"
    for bad in (-1, 2**63):
        with pytest.raises(FormatError, match="stamp_ns"):
            file_bytes(random_record(4), stamp_ns=bad)


@given(st.lists(st.integers(0, 2**47), unique=True))
def test_codes_round_trip(codes):
    array = np.array(sorted(codes), np.int64)
    np.testing.assert_array_equal(unshuffle_codes(shuffle_codes(array)), array)


def test_literal_bytes_of_columns():
    assert shuffle_codes(np.array([1, 3, 300])).tolist() == [[1, 2, 41], [0, 0, 1]]
    assert shuffle_codes(np.array([], np.int64)).shape == (1, 0)
    halves = np.array([[1.0, -2.0]], "<f2")  # 0x3c00, 0xc000
    assert shuffle(halves).tolist() == [[[0x00, 0x00]], [[0x3C, 0xC0]]]
    np.testing.assert_array_equal(unshuffle(shuffle(halves), "<f2"), halves)


def test_info_of_parts():
    record = random_record(5)
    data = file_bytes(record)
    file = read_map_file(io.BytesIO(data))
    assert file.size == len(data)
    assert file.metadata["frame_id"] == "map"
    assert [(p.topic, p.size) for p in file.parts] == [
        (p.topic, len(p.payload)) for p in parts_of(data)[:-1]
    ]
    assert 0 < sum(part.stored_size for part in file.parts) < len(data)


# The golden file


def test_golden_file_reads_back():
    assert GOLDEN.stat().st_size <= 40_000
    assert_same(read_map(GOLDEN), golden_record())


def test_golden_parts_are_what_the_writer_writes():
    """Compared before compression: another release of zstd may compress differently."""
    golden, now = GOLDEN.read_bytes(), file_bytes(golden_record())
    assert parts_of(now) == parts_of(golden)
    golden_metadata, metadata = metadata_of(golden)["triquad"], metadata_of(now)["triquad"]
    assert golden_metadata.pop("producer").startswith("triquad ")
    assert metadata.pop("producer").startswith("triquad ")
    assert metadata == golden_metadata


def test_stock_reader_sees_an_ordinary_file():
    data = file_bytes(golden_record())
    reader = make_reader(io.BytesIO(data), validate_crcs=True)
    assert reader.get_header().profile == ""
    assert reader.get_header().library.startswith("triquad ")
    summary = reader.get_summary()
    assert summary.statistics.message_count == len(parts_of(data))
    assert {channel.message_encoding for channel in summary.channels.values()} == {"msgpack"}
    assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
    assert parts_of(data)[-1].topic == "/triquad/manifest"


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
    data = file_bytes(golden_record())
    assert_same(read_bytes(rebuild(parts_of(data), metadata_of(data), **options)), golden_record())


# Damage


def refused_or_equal(data, record):
    """A file that is not the original reads back equal or is refused, and nothing else."""
    try:
        read = read_bytes(data)
    except MapFileError:
        return True
    assert_same(read, record)
    return False


def test_truncation_everywhere():
    data = GOLDEN.read_bytes()
    offsets = {*range(200), *range(0, len(data), 37), *range(len(data) - 600, len(data))}
    for offset in offsets:
        with pytest.raises(MapFileError):
            read_bytes(data[:offset])


def test_bit_flips():
    data, record = bytearray(GOLDEN.read_bytes()), golden_record()
    rng = np.random.default_rng(0)
    head_and_tail = [*range(8 * 300), *range(8 * (len(data) - 300), 8 * len(data), 3)]
    bits = [*head_and_tail[::3], *rng.integers(0, 8 * len(data), 1500)]
    refused = 0
    for bit in bits:
        data[bit // 8] ^= 1 << bit % 8
        refused += refused_or_equal(bytes(data), record)
        data[bit // 8] ^= 1 << bit % 8
    assert refused == len(bits)


def test_random_cuts_doublings_and_noise():
    data, record = GOLDEN.read_bytes(), golden_record()
    rng = np.random.default_rng(1)
    for _ in range(300):
        a, b = sorted(rng.integers(0, len(data), 2))
        for mutant in (
            data[:a] + data[b:],
            data[:b] + data[a:],
            data[:a] + rng.bytes(b - a) + data[b:],
            data[:a] + bytes(b - a) + data[b:],
        ):
            refused_or_equal(mutant, record)


def flatten_crcs(data):
    """The file with every MCAP checksum declared as not computed."""
    out, offset = bytearray(data), 8
    while offset < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, offset)
        if opcode == 0x0F:
            out[offset + 9 : offset + 13] = bytes(4)
        elif opcode == 0x02:
            out[offset + 25 : offset + 29] = bytes(4)
        elif opcode == 0x06:
            out[offset + 33 : offset + 37] = bytes(4)
        offset += 9 + length
    return bytes(out)


def test_bit_flips_without_crcs_are_found_by_digests():
    """Uncompressed and without CRCs, the manifest alone must hold."""
    record = golden_record()
    whole = file_bytes(record)
    plain = flatten_crcs(
        rebuild(parts_of(whole), metadata_of(whole), compression=CompressionType.NONE)
    )
    assert_same(read_bytes(plain), record)
    data = bytearray(plain)
    for bit in np.random.default_rng(2).integers(0, 8 * len(data), 1500):
        data[bit // 8] ^= 1 << bit % 8
        refused_or_equal(bytes(data), record)
        data[bit // 8] ^= 1 << bit % 8


def test_altered_parts_with_right_digests():
    """Hostile files: only errors of the family come out, whatever the parts hold."""
    data = GOLDEN.read_bytes()
    metadata = metadata_of(data)
    parts = parts_of(data)[:-1]
    rng = np.random.default_rng(3)
    for _ in range(1200):
        at = int(rng.integers(len(parts)))
        payload = bytearray(parts[at].payload)
        # Most flips hit the heads, where lengths, shapes and keys are.
        for _ in range(int(rng.integers(1, 4))):
            payload[int(len(payload) * rng.random() ** 3)] ^= 1 << int(rng.integers(8))
        mutant = [*parts[:at], Part(parts[at].topic, bytes(payload)), *parts[at + 1 :]]
        with contextlib.suppress(MapFileError):
            read_bytes(rebuild(listed(mutant), metadata, compression=CompressionType.NONE))


def test_parts_missing_reordered_doubled_swapped():
    data = file_bytes(random_record(6, indices=((0, 0, 0), (1, 0, 0))))
    parts, metadata = parts_of(data), metadata_of(data)
    for i in range(len(parts)):
        mutants = [[*parts[:i], *parts[i + 1 :]], [*parts[: i + 1], *parts[i:]]]
        if i:
            mutants.append([*parts[: i - 1], parts[i], parts[i - 1], *parts[i + 1 :]])
        for mutant in mutants:
            with pytest.raises(DamagedMapFileError):
                read_bytes(rebuild(mutant, metadata))


def test_swap_of_equal_parts_of_two_maps():
    changed = random_record(7)
    for table in changed.regions[0].tables:
        table.features[:] *= -1
    one, other = (parts_of(file_bytes(record)) for record in (random_record(7), changed))
    mixed = [*one[:2], *other[2:-1], one[-1]]
    with pytest.raises(DamagedMapFileError, match="not the one that the manifest lists"):
        read_bytes(rebuild(mixed, metadata_of(file_bytes(random_record(7)))))


# Messages


def test_messages_name_file_fault_and_remedy(tmp_path):
    path = tmp_path / "broken.triquad"
    path.write_bytes(GOLDEN.read_bytes()[:-100])
    with pytest.raises(DamagedMapFileError, match="broken.triquad .*incomplete.*older"):
        read_map(path)
    path.write_bytes(b"")
    with pytest.raises(DamagedMapFileError, match="empty"):
        read_map(path)
    for other in (b"PK\x03\x04 a zip file", b"\x89PNG\r\n\x1a\n" * 10):
        path.write_bytes(other)
        with pytest.raises(MapFileError, match="not a map file"):
            read_map(path)
    with pytest.raises(FileNotFoundError):
        read_map(tmp_path / "none.triquad")


def test_another_mcap_file():
    with pytest.raises(MapFileError, match="not a map"):
        read_bytes(rebuild([], {}))
    with pytest.raises(MapFileError, match="not a map"):
        read_bytes(rebuild([Part("/lidar", b"x")], {"other": {}}))


# Versions


def with_metadata(changes):
    data = file_bytes(random_record(9))
    metadata = metadata_of(data)
    metadata["triquad"].update(changes)
    metadata["triquad"] = {k: v for k, v in metadata["triquad"].items() if v is not None}
    return rebuild(parts_of(data), metadata)


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        ({"min_reader_version": "2"}, UnsupportedMapFileError, "version 2"),
        ({"required_features": "delta"}, UnsupportedMapFileError, "delta"),
        ({"required_features": "zeta, alpha"}, UnsupportedMapFileError, "alpha, zeta"),
        ({"required_features": None}, DamagedMapFileError, "required_features"),
        ({"min_reader_version": None}, DamagedMapFileError, "min_reader_version"),
        ({"min_reader_version": "one"}, DamagedMapFileError, "min_reader_version"),
        ({"min_reader_version": "9" * 5000}, DamagedMapFileError, "min_reader_version"),
        ({"epoch": "8"}, DamagedMapFileError, "epoch"),
        ({"frame_id": "odom"}, DamagedMapFileError, "frame_id"),
        ({"map": "other"}, DamagedMapFileError, "map"),
    ],
)
def test_metadata_is_checked(changes, error, text):
    with pytest.raises(error, match=text):
        read_bytes(with_metadata(changes))


def test_later_minor_versions_are_read():
    later = with_metadata({"format_version": "3", "colour": "green"})
    assert_same(read_bytes(later), random_record(9))


def test_unknown_parts_are_skipped_but_checked():
    data = file_bytes(random_record(10))
    parts, metadata = parts_of(data)[:-1], metadata_of(data)
    extra = Part("/triquad/colours", b"anything")
    longer = [*parts[:3], extra, *parts[3:], extra]
    preview = Part("/preview", b"not ours")
    assert_same(read_bytes(rebuild([preview, *listed(longer)], metadata)), random_record(10))
    with pytest.raises(DamagedMapFileError, match="colours"):
        read_bytes(rebuild([*parts[:3], extra, *parts[3:], parts_of(data)[-1]], metadata))


def test_unknown_fields_are_skipped():
    data = edited(file_bytes(random_record(11)), "/triquad/region", lambda b: b.update(more=[1]))
    assert_same(read_bytes(data), random_record(11))


# Hostile values, each with right checksums and digests


def replace_array(key, array):
    return lambda body: body.__setitem__(key, pack_array(array))


def set_field(key, value):
    return lambda body: body.__setitem__(key, value)


def lengthen(body):
    body["features"]["shape"][1] += 1


def nan_features(body):
    data = bytearray(body["features"]["data"])
    half = len(data) // 2
    data[0], data[half] = 0x00, 0x7C
    body["features"]["data"] = bytes(data)


HOSTILE = {
    "map: epoch": ("/triquad/map", set_field("epoch", -1)),
    "map: regions": ("/triquad/map", set_field("regions", 2**62)),
    "map: fewer regions": ("/triquad/map", set_field("regions", 0)),
    "map: region count is a bool": ("/triquad/map", set_field("regions", True)),
    "map: frame": ("/triquad/map", set_field("frame_id", "odom")),
    "map: name": ("/triquad/map", set_field("name", "../etc")),
    "map: no settings": ("/triquad/map", lambda b: b.pop("settings")),
    "map: a setting of another type": ("/triquad/map", lambda b: b["settings"].update(depth=6.0)),
    "map: a setting out of range": ("/triquad/map", lambda b: b["settings"].update(depth=40)),
    "map: a setting is NaN": ("/triquad/map", lambda b: b["settings"].update(leaf_m=float("nan"))),
    "map: settings of other shapes": ("/triquad/map", lambda b: b["settings"].update(hidden=6)),
    "map: huge integer": ("/triquad/map", lambda b: b["settings"].update(leaf_m=2**63)),
    "region: index": ("/triquad/region", set_field("region", [0, 0])),
    "region: index too large": ("/triquad/region", set_field("region", [2**40, 0, 0])),
    "region: other index": ("/triquad/region", set_field("region", [5, 5, 5])),
    "region: no vertex counts": ("/triquad/region", lambda b: b.pop("vertices")),
    "region: vertex counts": ("/triquad/region", lambda b: b["vertices"].__setitem__(0, 2**62)),
    "region: too few vertex counts": ("/triquad/region", lambda b: b["vertices"].pop()),
    "region: a vertex count is a bool": (
        "/triquad/region",
        lambda b: b["vertices"].__setitem__(0, True),
    ),
    "region: blocks": ("/triquad/region", set_field("blocks", 0)),
    "region: weights": ("/triquad/region", set_field("weights", [])),
    "region: weight": ("/triquad/region", lambda b: b["weights"].__setitem__(0, 7)),
    "region: frequencies": (
        "/triquad/region",
        replace_array("frequencies", np.full(4, np.inf, "<f4")),
    ),
    "region: frequencies of f8": ("/triquad/region", replace_array("frequencies", np.ones(4))),
    "region: training that is not there": ("/triquad/evidence", lambda b: b.clear()),
    "vertices: plane": ("/triquad/vertices", set_field("plane", 2)),
    "vertices: level": ("/triquad/vertices", set_field("level", 7)),
    "vertices: region": ("/triquad/vertices", set_field("region", [1, 0, 0])),
    "vertices: shape beyond the data": ("/triquad/vertices", lengthen),
    "vertices: NaN": ("/triquad/vertices", nan_features),
    "vertices: dtype is a list": (
        "/triquad/vertices",
        lambda b: b["features"].update(dtype=["<f2"]),
    ),
    "vertices: empty shape of astronomic size": (
        "/triquad/vertices",
        set_field("features", {"dtype": "|u1", "shape": [0, 2**39, 2**39], "data": b""}),
    ),
    "vertices: equal codes": (
        "/triquad/vertices",
        replace_array("codes", np.zeros((1, 3), np.uint8)),
    ),
    "vertices: no bytes per code": (
        "/triquad/vertices",
        replace_array("codes", np.zeros((0, 9), np.uint8)),
    ),
    "vertices: codes outside": (
        "/triquad/vertices",
        replace_array("codes", np.full((6, 3), 255, np.uint8)),
    ),
    "vertices: wide codes": (
        "/triquad/vertices",
        replace_array("codes", np.full((8, 3), 255, np.uint8)),
    ),
    "evidence: blocks outside": (
        "/triquad/evidence",
        replace_array("codes", np.full((2, 3), 255, np.uint8)),
    ),
    "evidence: masks": (
        "/triquad/evidence",
        replace_array("surface", np.zeros((1, 64), np.uint8)),
    ),
    "training: samples": ("/triquad/training", set_field("samples", 2**62)),
    "training: fewer samples": ("/triquad/training", set_field("samples", 1)),
    "training: steps": ("/triquad/training", set_field("mlp_steps", -1)),
    "training: visits": ("/triquad/training", set_field("visits_owed", 2**64 - 1)),
    "moments: steps": ("/triquad/moments", replace_array("steps", np.zeros((4, 1), np.uint8))),
    "moments: negative variance": (
        "/triquad/moments",
        lambda b: b["variances"].update(data=bytes([0xBF]) * len(b["variances"]["data"])),
    ),
    "samples: labels": ("/triquad/samples", replace_array("labels", np.zeros((2, 1), np.uint8))),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_values(case):
    topic, edit = HOSTILE[case]
    mutant = edited(file_bytes(random_record(12)), topic, edit)
    with pytest.raises(DamagedMapFileError if "frame" not in case else UnsupportedMapFileError):
        read_bytes(mutant)


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
    parts, metadata = parts_of(data), metadata_of(data)
    with pytest.raises(DamagedMapFileError):
        read_bytes(rebuild(listed([Part("/triquad/map", payload), *parts[1:-1]]), metadata))
    with pytest.raises(DamagedMapFileError):
        read_bytes(rebuild([*parts[:-1], Part("/triquad/manifest", payload)], metadata))


def test_other_encodings():
    data = file_bytes(random_record(13))
    with pytest.raises(DamagedMapFileError, match="json"):
        read_bytes(rebuild(parts_of(data), metadata_of(data), encoding="json"))
    with pytest.raises(UnsupportedMapFileError, match="lz4"):
        read_bytes(rebuild(parts_of(data), metadata_of(data), compression=CompressionType.LZ4))


def chunk_file(declared, stored, compression=b"zstd"):
    """An MCAP file with one chunk that declares any size."""
    chunk = struct.pack("<QQQI", 0, 0, declared, 0)
    chunk += struct.pack("<I", len(compression)) + compression
    chunk += struct.pack("<Q", len(stored)) + stored
    data = file_bytes(MapRecord("default", 0, SMALL, ()))
    header_end = 8 + 9 + struct.unpack_from("<Q", data, 9)[0]
    metadata_end = header_end + 9 + struct.unpack_from("<Q", data, header_end + 1)[0]
    body = data[:metadata_end] + struct.pack("<BQ", 6, len(chunk)) + chunk
    end = struct.pack("<BQI", 0x0F, 4, zlib.crc32(body))
    return body + end + struct.pack("<BQQQI", 0x02, 20, 0, 0, 0) + data[:8]


def test_bombs_are_not_allocated():
    bomb = zstandard.compress(bytes(50 * 2**20))
    for declared in (MAX_CHUNK_BYTES + 1, 2**63, 10):
        with pytest.raises(DamagedMapFileError, match="declares|contradicts"):
            read_bytes(chunk_file(declared, bomb))
    streamed = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(50 * 2**20))
    with pytest.raises(DamagedMapFileError):
        read_bytes(chunk_file(1000, streamed))
    with pytest.raises(DamagedMapFileError):
        read_bytes(chunk_file(1000, b"no zstd"))
    with pytest.raises(DamagedMapFileError):
        read_bytes(chunk_file(50 * 2**20, bomb + b"more"))


def test_total_is_limited():
    data = file_bytes(random_record(14, points=300))
    with pytest.raises(TooLargeMapFileError, match="limit"):
        read_map(io.BytesIO(data), max_bytes=len(data) + 100)
    with pytest.raises(TooLargeMapFileError, match="limit"):
        read_map(io.BytesIO(data), max_bytes=len(data) - 1)
    assert_same(read_map(io.BytesIO(data), max_bytes=10 * len(data)), random_record(14, points=300))


def test_parts_outside_chunks_are_limited(monkeypatch):
    data = file_bytes(random_record(14))
    monkeypatch.setattr(mapfile_reader, "MAX_PART_BYTES", 500)
    with pytest.raises(DamagedMapFileError, match="exceeds 500"):
        read_bytes(rebuild(parts_of(data), metadata_of(data), use_chunking=False))


def test_memory_error_is_named(monkeypatch):
    def out_of_memory(cursor):
        raise MemoryError

    monkeypatch.setattr(mapfile_reader, "unpack_record", out_of_memory)
    with pytest.raises(TooLargeMapFileError, match="memory"):
        read_map(GOLDEN)


# Writing


@pytest.mark.parametrize(
    "spoil",
    [
        lambda r: dataclasses.replace(r, epoch=-1),
        lambda r: dataclasses.replace(r, name="a/b"),
        lambda r: dataclasses.replace(r, regions=r.regions * 2),
        lambda r: dataclasses.replace(r, settings=dataclasses.replace(SMALL, hidden=9)),
        lambda r: dataclasses.replace(r, settings=dataclasses.replace(SMALL, depth=9)),
    ],
)
def test_unsound_records_are_not_written(tmp_path, spoil):
    path = tmp_path / "map.triquad"
    with pytest.raises(FormatError):
        write_map(spoil(random_record(15)), path)
    assert not list(tmp_path.iterdir())


def test_features_beyond_half_precision(tmp_path):
    record = random_record(16, feature_dtype="<f4")
    record.regions[0].tables[1].features[0, 0] = 1e6
    with pytest.raises(FormatError, match="1e\\+06|1000000"):
        write_map(record, tmp_path / "map.triquad")
    assert not list(tmp_path.iterdir())
    write_map(record, tmp_path / "map.triquad", feature_dtype="<f4")
    with pytest.raises(FormatError, match="feature_dtype"):
        write_map(record, tmp_path / "map.triquad", feature_dtype="<f8")


def test_total_limit_holds_while_writing(monkeypatch, tmp_path):
    path = tmp_path / "map.triquad"
    write_map(random_record(17), path)
    size = path.stat().st_size
    for limit in (2000, size - 1):
        monkeypatch.setattr("triquad_format.mapfile_writer.MAX_MAP_BYTES", limit)
        with pytest.raises(FormatError, match=f"at most {limit}"):
            write_map(random_record(18), path)
    assert_same(read_map(path), random_record(17))
    assert len(list(tmp_path.iterdir())) == 1


def test_part_limit(monkeypatch, tmp_path):
    monkeypatch.setattr("triquad_format.mapfile_writer.MAX_PART_BYTES", 200)
    with pytest.raises(FormatError, match="at most 200"):
        write_map(random_record(17), tmp_path / "map.triquad")


@pytest.mark.parametrize("step", ["write", "fsync", "replace"])
def test_interrupted_write_leaves_the_old_file(monkeypatch, tmp_path, step):
    path = tmp_path / "map.triquad"
    write_map(random_record(18), path)
    before = path.read_bytes()

    def fail(*_):
        raise OSError(28, "No space left on device")

    if step == "write":
        monkeypatch.setattr("triquad_format.mapfile_writer.pack_manifest", fail)
    else:
        monkeypatch.setattr(os, step, fail)
    with pytest.raises(OSError, match="No space"):
        write_map(random_record(19), path)
    monkeypatch.undo()
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["map.triquad"]
    write_map(random_record(19), path)
    assert_same(read_map(path), random_record(19))


def test_file_is_synced_before_and_folder_after_the_rename(monkeypatch, tmp_path):
    calls = []
    real_sync, real_replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda fd: (calls.append("fsync"), real_sync(fd))[1])
    monkeypatch.setattr(
        os, "replace", lambda *names: (calls.append("replace"), real_replace(*names))[1]
    )
    write_map(random_record(20), tmp_path / "map.triquad")
    assert calls == ["fsync", "replace", "fsync"]
