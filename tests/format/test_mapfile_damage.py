import dataclasses
import io
import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType
from support.map_records import assert_same, random_record
from support.mapfile_edit import (
    RawPart,
    file_bytes,
    listed,
    manifest_of,
    metadata_of,
    parts_of,
    read_bytes,
    rebuild,
    stored,
    stored_record,
    with_metadata,
)
from triquad_format.errors import (
    DamagedMapFileError,
    FormatError,
    MapFileError,
    NoIndexError,
    TooLargeMapFileError,
    UnsupportedMapFileError,
)
from triquad_format.mapfile import reader
from triquad_format.mapfile.reader import read_map

GOLDEN = Path(__file__).parents[1] / "golden" / "map_v1.triquad"


@pytest.fixture(scope="module")
def golden():
    return read_map(GOLDEN)


def is_refused(data, record, read=read_bytes):
    """Whether a file that is not the original is refused; it must read back equal otherwise."""
    try:
        have = read(data)
    except MapFileError:
        return True
    assert_same(have, record)
    return False


def test_truncation_everywhere():
    data = GOLDEN.read_bytes()
    offsets = {*range(200), *range(0, len(data), 37), *range(len(data) - 600, len(data))}
    for offset in offsets:
        with pytest.raises(MapFileError):
            read_bytes(data[:offset])
        with pytest.raises(MapFileError):
            stored(data[:offset])


def test_bit_flips(golden):
    data = bytearray(GOLDEN.read_bytes())
    rng = np.random.default_rng(0)
    head_and_tail = [*range(8 * 300), *range(8 * (len(data) - 300), 8 * len(data), 3)]
    for bit in [*head_and_tail[::3], *rng.integers(0, 8 * len(data), 1500)]:
        data[bit // 8] ^= 1 << bit % 8
        assert is_refused(bytes(data), golden)
        data[bit // 8] ^= 1 << bit % 8


def test_bit_flips_under_random_access():
    """What is not read is not checked: all that is answered is right nevertheless."""
    record = random_record(5, points=3, training=False)
    data = bytearray(file_bytes(record))
    rng = np.random.default_rng(0)
    refused = 0
    for bit in rng.integers(0, 8 * len(data), 600):
        data[bit // 8] ^= 1 << bit % 8
        refused += is_refused(bytes(data), record, stored_record)
        data[bit // 8] ^= 1 << bit % 8
    assert refused > 300


def test_random_cuts_doublings_and_noise(golden):
    data = GOLDEN.read_bytes()
    rng = np.random.default_rng(1)
    refused = 0
    for _ in range(150):
        a, b = sorted(rng.integers(0, len(data), 2))
        for mutant in (
            data[:a] + data[b:],
            data[:b] + data[a:],
            data[:a] + rng.bytes(b - a) + data[b:],
            data[:a] + bytes(b - a) + data[b:],
        ):
            refused += is_refused(mutant, golden)
            refused += is_refused(mutant, golden, stored_record)
    assert refused > 1000


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
    record = random_record(5, points=3, training=False)
    whole = file_bytes(record)
    plain = flatten_crcs(
        rebuild(parts_of(whole), metadata_of(whole), compression=CompressionType.NONE)
    )
    assert_same(read_bytes(plain), record)
    data = bytearray(plain)
    refused = 0
    for bit in np.random.default_rng(2).integers(0, 8 * len(data), 800):
        data[bit // 8] ^= 1 << bit % 8
        refused += is_refused(bytes(data), record)
        data[bit // 8] ^= 1 << bit % 8
    assert refused > 400
    with pytest.raises(NoIndexError, match="checksum"):
        stored(plain)


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
            with pytest.raises((DamagedMapFileError, NoIndexError)):
                stored_record(rebuild(mutant, metadata))


def test_parts_that_are_not_listed():
    data = file_bytes(random_record(6))
    parts, manifest = parts_of(data), manifest_of(data)
    for topic in ("region", "vertices", "moments", "samples"):
        at = [part.topic for part in parts].index(f"/triquad/{topic}")
        entries = (*manifest.own[:at], *manifest.own[at + 1 :])
        fewer = dataclasses.replace(manifest, entries=entries)
        mutant = rebuild(listed([*parts[:at], *parts[at + 1 : -1]], fewer), metadata_of(data))
        for read in (read_bytes, stored_record):
            with pytest.raises(DamagedMapFileError):
                read(mutant)


def test_swap_of_equal_parts_of_two_maps():
    changed = random_record(7)
    for table in changed.regions[0].tables:
        table.features[:] *= -1
    one, other = (parts_of(file_bytes(record)) for record in (random_record(7), changed))
    mixed = rebuild([*one[:2], *other[2:-1], one[-1]], metadata_of(file_bytes(random_record(7))))
    for read in (read_bytes, stored_record):
        with pytest.raises(DamagedMapFileError, match="not the one that the manifest lists"):
            read(mixed)


def test_messages_name_file_fault_and_remedy(tmp_path):
    path = tmp_path / "broken.triquad"
    path.write_bytes(GOLDEN.read_bytes()[:-100])
    with pytest.raises(DamagedMapFileError, match=r"broken.triquad .*incomplete.*older"):
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
    for parts, metadata in (([], {}), ([RawPart("/lidar", b"x")], {"other": {}})):
        other = rebuild(parts, metadata)
        with pytest.raises(MapFileError, match="not a map"):
            read_bytes(other)
        with pytest.raises(MapFileError, match="not a map" if metadata else "no index"):
            stored(other)


# Versions


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        ({"min_reader_version": "2"}, UnsupportedMapFileError, "version 2"),
        ({"required_features": "colour"}, UnsupportedMapFileError, "colour"),
        ({"required_features": "zeta, base-files, alpha"}, UnsupportedMapFileError, "alpha, zeta"),
        ({"required_features": None}, DamagedMapFileError, "required_features"),
        ({"min_reader_version": None}, DamagedMapFileError, "min_reader_version"),
        ({"min_reader_version": "one"}, DamagedMapFileError, "min_reader_version"),
        ({"min_reader_version": "9" * 5000}, DamagedMapFileError, "min_reader_version"),
        ({"epoch": "8"}, DamagedMapFileError, "epoch"),
        ({"frame_id": "odom"}, DamagedMapFileError, "frame_id"),
        ({"map": "other"}, DamagedMapFileError, "map"),
        ({"units": "ft"}, DamagedMapFileError, "units"),
    ],
)
def test_metadata_is_checked(changes, error, text):
    mutant = with_metadata(file_bytes(random_record(9)), changes)
    for read in (read_bytes, stored):
        with pytest.raises(error, match=text):
            read(mutant)


def test_later_minor_versions_are_read():
    changes = {"format_version": "4", "colour": "green"}
    later = with_metadata(file_bytes(random_record(9)), changes)
    assert_same(read_bytes(later), random_record(9))
    assert_same(stored_record(later), random_record(9))


def test_unknown_parts_are_skipped_but_checked():
    data = file_bytes(random_record(10))
    parts, metadata, manifest = parts_of(data)[:-1], metadata_of(data), manifest_of(data)
    extra = RawPart("/triquad/colours", b"anything")
    key = dataclasses.replace(manifest.own[0].key, topic=extra.topic)
    entry = dataclasses.replace(manifest.own[0], key=key)
    own = (*manifest.own[:3], entry, *manifest.own[3:])
    longer = dataclasses.replace(manifest, entries=own)
    whole = listed([*parts[:3], extra, *parts[3:]], longer)
    assert_same(read_bytes(rebuild(whole, metadata)), random_record(10))
    assert_same(stored_record(rebuild(whole, metadata)), random_record(10))
    lidar = RawPart("/lidar", b"not ours")
    assert_same(read_bytes(rebuild([lidar, *whole], metadata)), random_record(10))
    whole[3] = RawPart(extra.topic, b"something else")
    with pytest.raises(DamagedMapFileError, match="colours"):
        read_bytes(rebuild(whole, metadata))


def test_other_encodings():
    data = file_bytes(random_record(13))
    with pytest.raises(DamagedMapFileError, match="json"):
        read_bytes(rebuild(parts_of(data), metadata_of(data), encoding="json"))
    lz4 = rebuild(parts_of(data), metadata_of(data), compression=CompressionType.LZ4)
    for read in (read_bytes, stored):
        with pytest.raises(UnsupportedMapFileError, match="lz4"):
            read(lz4)


def test_total_is_limited():
    record = random_record(14, points=300)
    data = file_bytes(record)
    for limit in (len(data) + 100, len(data) - 1):
        with pytest.raises(TooLargeMapFileError, match="limit"):
            read_map(io.BytesIO(data), max_bytes=limit)
    assert_same(read_map(io.BytesIO(data), max_bytes=10 * len(data)), record)


def test_parts_outside_chunks_are_limited(monkeypatch):
    data = file_bytes(random_record(14))
    monkeypatch.setattr(reader, "MAX_PART_BYTES", 500)
    with pytest.raises(DamagedMapFileError, match="exceeds 500"):
        read_bytes(rebuild(parts_of(data), metadata_of(data), use_chunking=False))


def test_memory_error_is_named(monkeypatch):
    def out_of_memory(*_):
        raise MemoryError

    monkeypatch.setattr(reader, "assemble", out_of_memory)
    with pytest.raises(TooLargeMapFileError, match="memory"):
        read_map(GOLDEN)


def test_every_error_is_of_the_family():
    assert issubclass(NoIndexError, MapFileError)
    assert issubclass(MapFileError, FormatError)
