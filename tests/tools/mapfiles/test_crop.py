"""A map without what no answer in a box needs."""

import itertools

import numpy as np
import pytest
from support.maps.map_records import assert_same, random_record, with_support
from triquad_format.errors import FormatError
from triquad_format.records.region import seen_voxels
from triquad_map.composition.composed_view import RecordedView
from triquad_tools.mapfiles.crop import crop_record, without_training

CUBE = tuple(itertools.product((0, 1), repeat=3))


def box_points(low, high, count=2000):
    """Points in a box, many of them on its faces, edges and on leaf borders."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    points = np.random.default_rng(0).uniform(low, high, (count, 3))
    share = np.random.default_rng(1).integers(0, 4, (count, 3))
    points = np.where(share == 0, low, np.where(share == 1, high, points))
    snapped = np.clip(np.round(points[: count // 4] * 8) / 8, low, high)
    return np.concatenate([points, snapped])


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ([-1, -1, -1], [1, 1, 1]),
        ([-100, 2, 2], [100, 2.1, 2.1]),
        ([6.0001, 6, 6], [6.0002, 7, 7]),
    ],
)
def test_a_crop_answers_in_the_box_as_before(low, high):
    record = random_record(2, indices=CUBE, points=200)
    cropped = crop_record(record, low, high)
    points = box_points(low, high)
    before = RecordedView(record).query(points, gradient=True)
    after = RecordedView(cropped).query(points, gradient=True)
    np.testing.assert_array_equal(before.sdf, after.sdf)
    np.testing.assert_array_equal(before.status, after.status)
    np.testing.assert_array_equal(before.gradient, after.gradient)


def test_a_crop_drops_regions_that_the_box_does_not_meet():
    record = random_record(5, indices=CUBE)
    assert [r.index for r in crop_record(record, [0, 0, 0], [1, 1, 1]).regions] == [(0, 0, 0)]
    assert crop_record(record, [500, 0, 0], [501, 1, 1]).regions == ()
    everything = crop_record(record, [-1e9] * 3, [1e9] * 3)
    assert_same(everything, without_training(record))


def told_of(evidence):
    """Level, outcome, margins and time of each surface voxel; blocks without surface have none."""
    counts = np.unpackbits(evidence.surface, axis=1).sum(axis=1, dtype=np.int64)
    assert not evidence.seen_s[counts == 0].any()
    voxels = seen_voxels(evidence, evidence.surface)
    times = np.repeat(evidence.seen_s, counts)
    columns = (voxels, evidence.levels, evidence.outcomes, evidence.margins, times)
    return set(map(tuple, np.column_stack(columns).tolist()))


def test_a_crop_tells_the_same_of_the_surface_that_it_keeps():
    record = with_support(random_record(21, indices=CUBE[:2], points=500))
    cropped = crop_record(record, (-5, -6, -6), (30, 6, 5))
    for some, whole in zip(cropped.regions, record.regions, strict=True):
        assert set() < told_of(some.evidence) < told_of(whole.evidence)


@pytest.mark.parametrize(
    ("low", "high"), [([0, 0, 0], [1, 0, 1]), ([0, 0, 0], [1, np.nan, 1]), ([0] * 3, [np.inf] * 3)]
)
def test_bad_boxes(low, high):
    with pytest.raises(FormatError, match="box"):
        crop_record(random_record(), low, high)
