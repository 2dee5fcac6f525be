import dataclasses
import itertools
import os

import numpy as np
import pytest
from support import checkpoint_folder
from support.map_records import SMALL, assert_same, random_record, with_integers
from support.mapfile_edit import edited, file_bytes, set_array, stored, write_record
from triquad_format.errors import DamagedMapFileError, FormatError, MapFileError
from triquad_format.mapfile.index import FileBytes
from triquad_format.mapfile.reader import read_map
from triquad_format.mapfile.writer import write_map
from triquad_format.records import morton
from triquad_format.records.crop import crop_record, without_training
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import AXES
from triquad_map.reference.evaluator import MapEvaluator
from triquad_map.stored_map import StoredMap

CUBE = tuple(itertools.product((0, 1), repeat=3))
WIDE = dataclasses.replace(SMALL, depth=11, feature_levels=4)
"""A region of 512 m: 8 squares of 64 m along each side."""


class CountedFile(FileBytes):
    """Counts the bytes that are read."""

    bytes_read = 0

    def read(self, offset, length):
        self.bytes_read += length
        return super().read(offset, length)


def assert_same_answer(have, want):
    np.testing.assert_array_equal(have.sdf, want.sdf)
    np.testing.assert_array_equal(have.status, want.status)
    np.testing.assert_array_equal(have.gradient, want.gradient)


def near_borders(settings, count, seed):
    """Points near the borders of squares, and where vertices reach across them."""
    rng = np.random.default_rng(seed)
    square = settings.leaf_m * 256
    borders = rng.integers(-4, 5, (count, 3)) * square
    steps = rng.integers(-9, 10, (count, 3)) * settings.leaf_m
    return borders + steps + rng.choice([0.0, 1e-9, 1e-6, 1e-5, -1e-9, -1e-6, -1e-5], (count, 3))


def test_opening_and_asking_at_one_place_reads_index_and_tile_alone(tmp_path):
    record = random_record(40, settings=FieldSettings(), points=20_000)
    path = tmp_path / "map.triquad"
    write_map(record, path)
    source = CountedFile(path)
    with StoredMap(source) as map_file:
        opened = source.bytes_read
        index = opened / path.stat().st_size
        answer = map_file.query(np.array([[30.0, 30.0, 30.0]]), gradient=True)
        tile = source.bytes_read - opened
        map_file.query(np.array([[30.1, 30.1, 30.1]]))
        assert source.bytes_read == opened + tile
    parts = 1 + 3 + 1  # head of the region, a square of each plane, a cube
    assert len(map_file.manifest.entries) > 500 * parts
    assert index < 0.1
    assert 0 < tile < 0.02 * path.stat().st_size
    assert_same_answer(answer, MapEvaluator(record).query(np.array([[30.0] * 3]), gradient=True))


@pytest.mark.parametrize("integers", [False, True])
def test_answers_are_those_of_the_whole_map(tmp_path, integers):
    record = random_record(41, settings=WIDE, points=3000, training=False)
    record = with_integers(record) if integers else record
    path = tmp_path / "map.triquad"
    write_map(record, path)
    points = near_borders(WIDE, 400, 0)
    whole = MapEvaluator(read_map(path))
    for place in np.split(points, 20):
        with StoredMap.open(path) as map_file:
            answer = map_file.query(place, gradient=True)
        assert_same_answer(answer, whole.query(place, gradient=True))


def test_answers_do_not_hang_on_what_was_asked_before(tmp_path):
    """Up to eight regions are blended, of which each query finds some read already."""
    record = random_record(42, indices=CUBE, points=200)
    path = tmp_path / "map.triquad"
    write_map(record, path)
    points = np.random.default_rng(1).uniform(-8, 20, (400, 3))
    points[::2] = np.random.default_rng(2).uniform(4, 8, (200, 3))
    whole = MapEvaluator(read_map(path))
    with StoredMap.open(path) as map_file:
        for place in np.split(points[::-1], 40):
            answer = map_file.query(place, gradient=True)
            assert_same_answer(answer, whole.query(place, gradient=True))


def test_far_from_the_centre_rounding_does_not_leave_a_square(tmp_path):
    """Positions become single precision: at depth 15 that moves them across borders."""
    settings = dataclasses.replace(WIDE, depth=15)
    rng = np.random.default_rng(3)
    border = -(2**14) + 256 * rng.integers(1, 128, (30, 3))
    points = (border - rng.choice([8, 4, 0], (30, 3)) - 1e-5) * settings.leaf_m
    record = random_record(43, settings=settings, points=1, training=False)
    (region,) = record.regions
    leaves = np.round(points / settings.leaf_m + 2**14).astype(np.int64)
    record = dataclasses.replace(record, regions=(covering(region, settings, leaves),))
    whole = MapEvaluator(record)
    path = tmp_path / "map.triquad"
    write_map(record, path, feature_dtype="<f4")
    for point in points:
        with StoredMap.open(path) as map_file:
            answer = map_file.query(point[None], gradient=True)
        assert_same_answer(answer, whole.query(point[None], gradient=True))


def covering(region, settings, leaves):
    """The region with all vertices around some leaves [N, 3]."""
    rng = np.random.default_rng(4)
    tables = []
    for table in region.tables:
        nodes = leaves[:, AXES[table.plane]] >> (settings.depth - table.level)
        around = np.concatenate([nodes + (a, b) for a in (-1, 0, 1, 2) for b in (-1, 0, 1, 2)])
        codes = np.unique(morton.encode(np.clip(around, 0, 1 << table.level)))
        features = rng.normal(size=(len(codes), settings.feature_size)).astype(np.float32)
        tables.append(dataclasses.replace(table, codes=codes, features=features))
    return dataclasses.replace(region, tables=tuple(tables))


BOXES = [
    ([-1, -1, -1], [1, 1, 1]),
    ([60.25, -64.5, 3.75], [64.0, -63.9, 70.0]),
    ([-1000, 2, 2], [1000, 2.1, 2.1]),
    ([300, 300, 300], [301, 301, 301]),
]


@pytest.mark.parametrize(("low", "high"), BOXES)
def test_a_box_holds_what_it_needs(tmp_path, low, high):
    record = random_record(44, settings=WIDE, points=3000)
    path = tmp_path / "map.triquad"
    write_map(record, path)
    with StoredMap.open(path) as map_file:
        cropped = crop_record(map_file.box(low, high), low, high)
    wanted = without_training(crop_record(read_map(path), low, high))
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


@pytest.mark.parametrize(
    ("low", "high"), [([1, 0, 0], [0, 1, 1]), ([0, 0, 0], [1, 1, np.nan]), ([0, 0, 0], [0, 1, 1])]
)
def test_boxes_out_of_order_are_refused(low, high):
    with stored(file_bytes(random_record(45))) as map_file, pytest.raises(FormatError, match="box"):
        map_file.box(low, high)


@pytest.mark.parametrize("bad", [np.zeros(3), np.zeros((2, 2)), np.array([[0, 0, np.inf]])])
def test_points_are_checked(bad):
    with stored(file_bytes(random_record(45))) as map_file, pytest.raises(FormatError):
        map_file.query(bad)


def test_outside_of_all_regions_nothing_is_known():
    with stored(file_bytes(random_record(45))) as map_file:
        answer = map_file.query(np.array([[1e6, 0.0, 0.0], [-1e300, 0.0, 0.0]]), gradient=True)
        assert np.isnan(answer.sdf).all()
        assert not answer.status.any()
        assert len(map_file.query(np.zeros((0, 3))).sdf) == 0


# A file that changes while it is open


def test_a_deleted_file_answers_on(tmp_path):
    record = random_record(46)
    path = tmp_path / "map.triquad"
    write_map(record, path)
    with StoredMap.open(path) as map_file:
        path.unlink()
        assert_same(map_file.record(), record)
    with pytest.raises(FileNotFoundError):
        StoredMap.open(path)


def test_a_replaced_file_answers_as_before(tmp_path):
    record = random_record(46)
    path = tmp_path / "map.triquad"
    write_map(record, path)
    with StoredMap.open(path) as map_file:
        write_map(random_record(47), path)
        assert_same(map_file.record(), record)


def test_a_file_cut_meanwhile_is_named(tmp_path):
    record = random_record(46, indices=((0, 0, 0), (3, 0, 0)))
    path = tmp_path / "map.triquad"
    write_map(record, path)
    far = np.array([[36.0, 0.0, 0.0]])
    with StoredMap.open(path) as map_file:
        near = map_file.query(np.zeros((1, 3)))
        os.truncate(path, path.stat().st_size // 2)
        for _ in range(2):
            with pytest.raises(DamagedMapFileError, match=r"map.triquad.*cut to"):
                map_file.query(far)
        assert map_file.query(np.zeros((1, 3))).sdf == near.sdf


def test_a_checkpoint_answers_as_the_map_in_one_file_does(tmp_path):
    record = random_record(48, indices=((0, 0, 0), (3, 0, 0)))
    path = checkpoint_folder.write_record(tmp_path, record)
    points = np.random.default_rng(1).uniform(-8, 44, (200, 3))
    with StoredMap.open(path) as map_file, stored(file_bytes(record)) as whole:
        assert_same_answer(map_file.query(points, True), whole.query(points, True))
        assert_same(map_file.record(), record)


def test_a_part_deleted_before_it_is_needed(tmp_path):
    path = checkpoint_folder.write_record(tmp_path, random_record(48, indices=((3, 0, 0),)))
    with StoredMap.open(path) as map_file:
        for part in (tmp_path / "parts").iterdir():
            part.unlink()
        for _ in range(2):
            with pytest.raises(DamagedMapFileError, match=r"checkpoint .*parts/.* is missing"):
                map_file.query(np.array([[36.0, 0.0, 0.0]]))


def test_damage_in_one_region_leaves_the_others(tmp_path):
    record = random_record(49, indices=((0, 0, 0), (3, 0, 0)))
    data = file_bytes(record)
    hostile = set_array("frequencies", np.full(4, np.inf, "<f4"))
    near, far = np.zeros((1, 3)), np.array([[36.0, 0.0, 0.0]])
    with stored(edited(data, "/triquad/region", hostile, number=1)) as map_file:
        for _ in range(2):
            with pytest.raises(DamagedMapFileError, match="frequencies"):
                map_file.query(far)
            have = map_file.query(near, gradient=True)
            assert_same_answer(have, MapEvaluator(record).query(near, gradient=True))


def test_errors_name_the_file(tmp_path):
    path = tmp_path / "broken.triquad"
    write_record(path, random_record(50))
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(DamagedMapFileError, match=r"broken.triquad.*triquad-pack"):
        StoredMap.open(path)
    path.write_bytes(b"GIF89a")
    with pytest.raises(MapFileError, match=r"broken.triquad.*not a map file"):
        StoredMap.open(path)
