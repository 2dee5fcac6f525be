"""What a writer refuses, and that a path gets all of a file or nothing of it."""

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.maps.map_records import (
    SMALL,
    assert_same,
    random_record,
    with_evidence,
    with_integers,
    with_region,
)
from triquad_format.errors import FormatError
from triquad_format.mapfile.reader import read_map
from triquad_format.mapfile.writer import write_map
from triquad_format.records import morton
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import MAX_INTEGER, MapProgress, MapRecord


def with_table(record: MapRecord, **changes: Any) -> MapRecord:
    """The record with changes to the first table of its first region."""
    first, *others = record.regions[0].tables
    return with_region(record, tables=(dataclasses.replace(first, **changes), *others))


INVALID: dict[str, Callable[[MapRecord], MapRecord]] = {
    "scans below none": lambda r: dataclasses.replace(r, progress=MapProgress(-1)),
    "epoch": lambda r: dataclasses.replace(r, epoch=-1),
    "name": lambda r: dataclasses.replace(r, name="a/b"),
    "a region twice": lambda r: dataclasses.replace(r, regions=r.regions * 2),
    "shapes": lambda r: dataclasses.replace(r, settings=dataclasses.replace(SMALL, hidden=9)),
    "a scale without integers": lambda r: with_table(r, scale=0.5),
    "integers beyond two bytes": lambda r: with_table(
        with_integers(r), features=with_integers(r, MAX_INTEGER).regions[0].tables[0].features + 1
    ),
    "no scale": lambda r: with_table(with_integers(r), scale=0.0),
    "a scale above single precision": lambda r: with_table(with_integers(r), scale=1e60),
}


@pytest.mark.parametrize("case", INVALID)
def test_invalid_records_are_not_written(tmp_path: Path, case: str) -> None:
    path = tmp_path / "map.triquad"
    with pytest.raises(FormatError):
        write_map(INVALID[case](random_record(15)), path)
    assert not list(tmp_path.iterdir())


INVALID_EVIDENCE = {
    "a level less": ("levels", np.zeros(39, np.uint8), r"levels: expected an array \[40\]"),
    "a level too high": ("levels", np.full(40, 8, np.uint8), "levels: one exceeds 7"),
    "a time for each voxel": ("seen_s", np.zeros(40, np.int64), r"seen_s: expected .* \[38\]"),
    "a time before 1970": ("seen_s", np.full(38, -1), "seen_s: a time lies outside"),
    "more hits than the code has": (
        "outcomes",
        np.full((40, 3), 4, np.uint8),
        "outcomes: a code exceeds",
    ),
}


@pytest.mark.parametrize("case", INVALID_EVIDENCE)
def test_invalid_evidence_is_not_written(tmp_path: Path, case: str) -> None:
    field, array, message = INVALID_EVIDENCE[case]
    with pytest.raises(FormatError, match=message):
        write_map(with_evidence(random_record(15), **{field: array}), tmp_path / "map.triquad")
    assert not list(tmp_path.iterdir())


def test_features_beyond_half_precision(tmp_path: Path) -> None:
    record = random_record(16, feature_dtype="<f4")
    record.regions[0].tables[1].features[0, 0] = 1e6
    with pytest.raises(FormatError, match="1e\\+06|1000000"):
        write_map(record, tmp_path / "map.triquad")
    assert not list(tmp_path.iterdir())
    write_map(record, tmp_path / "map.triquad", feature_dtype="<f4")
    with pytest.raises(FormatError, match="feature_dtype"):
        write_map(record, tmp_path / "map.triquad", feature_dtype="<f8")


def test_total_limit_holds_while_writing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "map.triquad"
    write_map(random_record(17), path)
    size = path.stat().st_size
    for limit in (2000, size - 1):
        monkeypatch.setattr("triquad_format.mapfile.manifest.MAX_MAP_BYTES", limit)
        with pytest.raises(FormatError, match=f"limit of {limit} bytes"):
            write_map(random_record(18), path)
    monkeypatch.undo()
    assert_same(read_map(path), random_record(17))
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(
    ("limit", "most", "message"),
    [
        ("parts.pack.MAX_PART_BYTES", 200, "at most 200"),
        ("manifest.MAX_ENTRIES", 0, "at most"),
        ("manifest.total_limit", lambda _: 1000, "in a file of"),  # an attack, to readers
    ],
)
def test_what_readers_would_refuse_is_not_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, limit: str, most: object, message: str
) -> None:
    monkeypatch.setattr(f"triquad_format.mapfile.{limit}", most)
    with pytest.raises(FormatError, match=message):
        write_map(random_record(17), tmp_path / "map.triquad")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("step", ["write", "fsync", "replace"])
def test_interrupted_write_leaves_the_old_file(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, step: str
) -> None:
    path = tmp_path / "map.triquad"
    write_map(random_record(18), path)
    before = path.read_bytes()

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    if step == "write":
        monkeypatch.setattr("triquad_format.mapfile.writer.pack_manifest", fail)
    else:
        monkeypatch.setattr(os, step, fail)
    with pytest.raises(OSError, match="No space"):
        write_map(random_record(19), path)
    monkeypatch.undo()
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["map.triquad"]
    write_map(random_record(19), path)
    assert_same(read_map(path), random_record(19))


def test_file_is_synced_before_and_folder_after_the_rename(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    calls: list[str] = []
    real_sync, real_replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda fd: (calls.append("fsync"), real_sync(fd))[1])
    monkeypatch.setattr(
        os, "replace", lambda *names: (calls.append("replace"), real_replace(*names))[1]
    )
    write_map(random_record(20), tmp_path / "map.triquad")
    assert calls == ["fsync", "replace", "fsync"]


def test_what_shrinks_to_a_thousandth_is_read(tmp_path: Path) -> None:
    wide = FieldSettings(depth=8, feature_levels=1, feature_size=64)
    record = random_record(0, settings=wide, training=False, feature_dtype="<f4")
    cells = np.stack(np.meshgrid(np.arange(256), np.arange(256)), axis=-1).reshape(-1, 2)
    codes = np.sort(morton.encode(cells))
    record = with_table(record, codes=codes, features=np.zeros((len(codes), 64), np.float32))
    path = tmp_path / "map.triquad"
    write_map(record, path, feature_dtype="<f4")
    assert_same(read_map(path), record)


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir], ids=["a pipe", "a folder"])
def test_what_is_no_file_is_not_replaced(tmp_path: Path, make: Callable[[Path], None]) -> None:
    """As root, a device such as /dev/null would be gone."""
    there, link = tmp_path / "there.triquad", tmp_path / "link.triquad"
    make(there)
    link.symlink_to(there)
    before = there.stat()
    for path in (there, link):
        with pytest.raises(OSError, match=path.name):
            write_map(random_record(18), path)
    assert (there.stat().st_ino, there.stat().st_mode) == (before.st_ino, before.st_mode)
    assert link.is_symlink()
    assert len(list(tmp_path.iterdir())) == 2
