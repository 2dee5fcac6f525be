"""Questions in slices are answered as whole ones are, and end where their turn does."""

import dataclasses

import numpy as np
import pytest
from support.exact_maps import exact_map, table
from triquad_map.compiled.recorded_view import RecordedView
from triquad_map.questions.distance import DistanceOptions, distances
from triquad_map.questions.segments import SegmentOptions, segments
from triquad_map.questions.slices import SlicedView


@pytest.fixture(scope="module")
def view():
    recorded = RecordedView(exact_map(table(0.0, 1.0)))
    yield recorded
    recorded.close()


def points(count=1000):
    return np.random.default_rng(0).uniform((-8, -8, -1), (8, 8, 3), (count, 3))


def same(first, second):
    for field in dataclasses.fields(first):
        np.testing.assert_array_equal(getattr(first, field.name), getattr(second, field.name))


@pytest.mark.parametrize("size", [1, 7, 999, 1000, 5000])
def test_answers_are_those_of_the_whole(view, size):
    sliced, asked = SlicedView(view, lambda: size), points()
    options = DistanceOptions(3.0, surface_point=True, unknown_distance=True)
    same(distances(sliced, asked, options), distances(view, asked, options))
    same(sliced.query(asked, gradient=True), view.query(asked, gradient=True))
    assert sliced.query(asked)._gradient is None
    ways = asked[:50], asked[50:100], SegmentOptions(radius_m=0.3, max_distance_m=2.0)
    same(segments(sliced, *ways), segments(view, *ways))


def test_no_points_are_a_question_too(view):
    empty = np.empty((0, 3))
    same(SlicedView(view, lambda: 10).query(empty), view.query(empty))


def test_what_a_turn_raises_ends_the_question(view):
    turns = iter([100, 100])

    def turn():
        try:
            return next(turns)
        except StopIteration:
            raise TimeoutError from None

    with pytest.raises(TimeoutError):
        SlicedView(view, turn).nearest_surface(points(), 3.0)
