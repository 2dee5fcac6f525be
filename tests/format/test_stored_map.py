import dataclasses
import os

import numpy as np
import pytest
from support.files import checkpoint_folder
from support.files.mapfile_edit import edited, file_bytes, set_array, stored
from support.maps.map_records import SMALL, assert_same, random_record, with_support
from triquad_format.errors import DamagedMapFileError
from triquad_format.mapfile.files import FileBytes
from triquad_format.mapfile.reader import StoredMap, read_map
from triquad_format.mapfile.writer import write_map
from triquad_tools.mapfiles.crop import crop_record

WIDE = dataclasses.replace(SMALL, depth=11, feature_levels=4)
"""A region of 512 m: 8 squares of 64 m along each side."""


class CountedFile(FileBytes):
    """Counts the bytes that are read."""

    bytes_read = 0

    def read(self, offset, length):
        self.bytes_read += length
        return super().read(offset, length)


BOXES = [
    ([-1, -1, -1], [1, 1, 1]),
    ([60.25, -64.5, 3.75], [64.0, -63.9, 70.0]),
    ([-1000, 2, 2], [1000, 2.1, 2.1]),
    ([300, 300, 300], [301, 301, 301]),
]


@pytest.mark.parametrize(("low", "high"), BOXES)
def test_a_box_holds_what_it_needs(tmp_path, low, high):
    record = with_support(random_record(44, settings=WIDE, points=3000))
    path = tmp_path / "map.triquad"
    write_map(record, path)
    with StoredMap.open(path) as map_file:
        cropped = crop_record(map_file.box(low, high), low, high)
    wanted = crop_record(read_map(path), low, high)
    if any(len(table.codes) == 0 for region in wanted.regions for table in region.tables):
        assert_same_places(cropped, wanted)
    else:
        assert_same(cropped, wanted)


def assert_same_places(have, want):
    """No rows are of any dtype."""
    for one, other in zip(have.regions, want.regions, strict=True):
        for a, b in zip(one.tables, other.tables, strict=True):
            np.testing.assert_array_equal(a.codes, b.codes)
            np.testing.assert_array_equal(a.features, b.features)
        assert_same(one.evidence, other.evidence)


def test_a_small_box_is_read_from_few_parts(tmp_path):
    path = tmp_path / "map.triquad"
    write_map(random_record(44, settings=WIDE, points=3000), path)
    source = CountedFile(path)
    with StoredMap(source) as map_file:
        map_file.box([-1, -1, -1], [1, 1, 1])
        assert source.bytes_read < 0.2 * path.stat().st_size


# A file that changes while it is open

NEAR, FAR = ([-1, -1, -1], [1, 1, 1]), ([35, -1, -1], [37, 1, 1])
"""Boxes in the regions (0, 0, 0) and (3, 0, 0)."""


def test_a_deleted_file_answers_on(tmp_path):
    record = random_record(46)
    path = tmp_path / "map.triquad"
    write_map(record, path)
    with StoredMap.open(path) as map_file:
        path.unlink()
        assert_same(map_file.whole().record, record)
    with pytest.raises(FileNotFoundError):
        StoredMap.open(path)


def test_a_file_cut_meanwhile_is_named(tmp_path):
    record = random_record(46, indices=((0, 0, 0), (3, 0, 0)))
    path = tmp_path / "map.triquad"
    write_map(record, path)
    with StoredMap.open(path) as map_file:
        near = map_file.box(*NEAR)
        os.truncate(path, path.stat().st_size // 2)
        for _ in range(2):
            with pytest.raises(DamagedMapFileError, match=r"map.triquad.*cut to"):
                map_file.box(*FAR)
        assert_same(map_file.box(*NEAR), near)


def test_a_checkpoint_holds_what_the_map_in_one_file_does(tmp_path):
    record = random_record(48, indices=((0, 0, 0), (3, 0, 0)))
    path = checkpoint_folder.write_record(tmp_path, record)
    with StoredMap.open(path) as map_file, stored(file_bytes(record)) as whole:
        assert_same(map_file.box(*FAR), whole.box(*FAR))
        assert_same(map_file.whole().record, record)


def test_a_part_deleted_before_it_is_needed(tmp_path):
    path = checkpoint_folder.write_record(tmp_path, random_record(48, indices=((3, 0, 0),)))
    with StoredMap.open(path) as map_file:
        for part in (tmp_path / "parts").iterdir():
            part.unlink()
        for _ in range(2):
            with pytest.raises(DamagedMapFileError, match=r"checkpoint .*parts/.* is missing"):
                map_file.box(*FAR)


def test_damage_in_one_region_leaves_the_others(tmp_path):
    record = random_record(49, indices=((0, 0, 0), (3, 0, 0)))
    data = file_bytes(record)
    hostile = set_array("frequencies", np.full(4, np.inf, "<f4"))
    with stored(data) as map_file:
        near = map_file.box(*NEAR)
    with stored(edited(data, "/triquad/region", hostile, number=1)) as map_file:
        for _ in range(2):
            with pytest.raises(DamagedMapFileError, match="frequencies"):
                map_file.box(*FAR)
            assert_same(map_file.box(*NEAR), near)
