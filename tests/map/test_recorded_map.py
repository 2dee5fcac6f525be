"""A map record answers alike in compiled code and with numpy alone, which is the reference."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.exact_maps import exact_map, flat, table
from support.map_records import SMALL, random_record, with_support
from triquad_format.records.region import MapRecord
from triquad_format.records.status import Status
from triquad_map.compiled.evidence.live_evidence import LiveEvidence
from triquad_map.compiled.recorded_view import RecordedView
from triquad_map.compiled.surfels.surfel_map import surfel_places
from triquad_map.compiled.surfels.surfel_search import find_nearest
from triquad_map.compiled.surfels.surfel_tree import surfel_tree
from triquad_map.composition.region import no_surfels
from triquad_map.questions.distance import DistanceOptions, distances
from triquad_map.questions.grid import GridShape, grid
from triquad_map.questions.ground import ground as ground_below
from triquad_map.questions.rays import RayOptions, rays
from triquad_map.questions.segments import SegmentOptions, segments
from triquad_map.questions.spheres import spheres
from triquad_map.reference.evaluator import MapEvaluator
from triquad_map.reference.surfel_cloud import SurfelCloud
from triquad_map.surface import SurfelKind, Surfels
from triquad_map.view import MapView

TWO = ((0, 0, 0), (1, 0, 0))
APART = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (-4, 2, 1))
"""Neighbours by a face and by an edge, and one far away."""


def both(record):
    return RecordedView(record), MapEvaluator(record)


def around(record, count, seed):
    """Points in and between the regions of a map, and outside of all."""
    rng = np.random.default_rng(seed)
    centres = np.array([region.index for region in record.regions]) * record.settings.region_pitch_m
    side = record.settings.region_side_m
    near = centres[rng.integers(len(centres), size=count)] + rng.uniform(-side, side, (count, 3))
    low, high = centres.min(axis=0) - side, centres.max(axis=0) + side
    return np.concatenate([near, rng.uniform(low, high, (count, 3))])


@given(st.integers(0, 10**6), st.sampled_from([(), TWO, APART]), st.floats(0.1, 12.0))
@settings(max_examples=30, deadline=None)
def test_the_nearest_unknown_space_is_the_same(seed, indices, reach_m):
    record = random_record(seed, indices=indices, points=60, training=False)
    points = around(record, 150, seed) if indices else np.zeros((3, 3))
    fast, slow = (view.nearest_unknown(points, reach_m) for view in both(record))
    np.testing.assert_allclose(fast.distance, slow.distance, atol=1e-9)
    there = slow.distance < reach_m
    for found in (fast, slow):
        gaps = np.linalg.norm(points - found.point, axis=1)
        np.testing.assert_allclose(gaps[there], found.distance[there], atol=1e-9)


@given(st.integers(0, 10**6), st.integers(0, 300), st.floats(0.3, 80.0))
@settings(max_examples=40, deadline=None)
def test_the_nearest_surfel_is_the_same(seed, count, reach):
    rng = np.random.default_rng(seed)
    live = LiveEvidence(64)
    live.mark_surface(rng.uniform(0, 64, (count, 3)) * (1, 1, 0.3))
    evidence = live.freeze()
    places = surfel_places(evidence.cells, evidence.surface)
    surfels = random_surfels(rng, len(places.voxels()))
    points = rng.uniform(-20, 84, (400, 3))
    points[:200] = rng.uniform(0, 64, (200, 3)) * (1, 1, 0.3)
    fast, slow = nearest_both_ways(places, surfels, points, reach)
    np.testing.assert_allclose(fast.distances, slow.distances, atol=1e-4)
    np.testing.assert_array_equal(fast.rows >= 0, slow.rows >= 0)
    hit = slow.rows >= 0
    for found in (fast, slow):
        gaps = np.linalg.norm(points - found.closest, axis=1)
        np.testing.assert_allclose(gaps[hit], found.distances[hit], atol=1e-4)
    same = hit & (fast.rows == slow.rows)
    assert (same == hit).mean() > 0.99  # but for ties
    np.testing.assert_allclose(fast.means[hit], slow.means[hit], atol=1e-3)


def nearest_both_ways(places, surfels, points, reach):
    """What compiled code finds, and what the reference does."""
    fast, slow = (no_surfels(np.full(len(points), reach)) for _ in range(2))
    find_nearest(points, surfel_tree(places.shape, places.voxels(), surfels), fast)
    count = len(places.voxels())
    cloud = SurfelCloud(places.voxels(), surfels, np.ones(count), np.zeros(count, int))
    cloud.find_nearest(points, slow)
    return fast, slow


@pytest.mark.parametrize("reach", [30.0, 1e4])
def test_the_nearest_surfel_is_the_same_where_surfaces_are_far_apart(reach):
    rng = np.random.default_rng(7)
    live = LiveEvidence(4096)
    middles = rng.uniform(100, 3996, (12, 3))
    live.mark_surface(middles[rng.integers(12, size=3000)] + rng.uniform(-6, 6, (3000, 3)))
    evidence = live.freeze()
    places = surfel_places(evidence.cells, evidence.surface)
    surfels = random_surfels(rng, len(places.voxels()))
    near = middles[rng.integers(12, size=200)] + rng.uniform(-40, 40, (200, 3))
    points = np.concatenate([near, rng.uniform(-900, 5000, (200, 3))])
    fast, slow = nearest_both_ways(places, surfels, points, reach)
    np.testing.assert_allclose(fast.distances, slow.distances, atol=2e-3)
    hit = slow.rows >= 0
    np.testing.assert_array_equal(fast.rows >= 0, hit)
    gaps = np.linalg.norm(points - fast.means, axis=1)[hit]
    np.testing.assert_allclose(gaps, np.linalg.norm(points - slow.means, axis=1)[hit], atol=0.02)


def test_of_more_surfels_than_count_in_the_direction_the_nearest_is_found():
    rng = np.random.default_rng(8)
    middle = np.full(3, 32.0)
    live = LiveEvidence(64)
    directions = rng.normal(size=(60_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    live.mark_surface(middle + 25.0 * directions)  # as seen from inside a ball
    evidence = live.freeze()
    places = surfel_places(evidence.cells, evidence.surface)
    away = places.voxels() + 0.5 - middle
    lengths = np.linalg.norm(away, axis=1, keepdims=True)
    offsets = (25.0 / lengths - 1.0) * away
    kinds = np.full(len(away), SurfelKind.DISC, np.uint8)
    surfels = Surfels(offsets.astype(np.float32), (-away / lengths).astype(np.float32), kinds)
    points = middle + rng.normal(size=(50, 3)) * 0.02
    fast, slow = nearest_both_ways(places, surfels, points, 60.0)
    np.testing.assert_allclose(fast.distances, slow.distances, atol=1e-4)
    assert np.isfinite(fast.means).all()
    assert (np.linalg.norm(fast.means - middle, axis=1) < 25.5).all()


def test_what_is_found_for_a_point_hangs_on_no_other_point():
    rng = np.random.default_rng(9)
    live = LiveEvidence(64)
    live.mark_surface(rng.uniform(0, 64, (3000, 3)) * (1, 1, 0.1))
    evidence = live.freeze()
    places = surfel_places(evidence.cells, evidence.surface)
    surfels = random_surfels(rng, len(places.voxels()))
    tree = surfel_tree(places.shape, places.voxels(), surfels)
    points = rng.uniform(-10, 74, (300, 3))
    together = no_surfels(np.full(300, 50.0))
    find_nearest(points, tree, together)
    for order in (rng.permutation(300), *np.arange(300)[:, None]):
        found = no_surfels(np.full(len(order), 50.0))
        find_nearest(points[order], tree, found)
        for mine, wanted in zip(found, together, strict=True):
            np.testing.assert_array_equal(mine, wanted[order])


def random_surfels(rng, count):
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Surfels(
        rng.uniform(-0.5, 0.5, (count, 3)).astype(np.float32),
        normals.astype(np.float32),
        rng.integers(0, len(SurfelKind), count).astype(np.uint8),
    )


@pytest.fixture(scope="module", params=["flat", "table"])
def ground(request):
    """The views of a ground whose field is exact."""
    return both(exact_map(flat(0.07) if request.param == "flat" else table(0.0, 1.3)))


def places(count, seed=0):
    return np.random.default_rng(seed).uniform([-14, -14, -2], [14, 14, 6], (count, 3))


def test_the_field_and_the_status_are_the_same(ground):
    fast, slow = ground
    points = np.concatenate([places(2000), 100.0 + places(10)])
    have, want = fast.query(points, gradient=True), slow.query(points, gradient=True)
    np.testing.assert_allclose(have.sdf, want.sdf, atol=1e-5)
    np.testing.assert_allclose(have.gradient, want.gradient, atol=1e-4)
    np.testing.assert_array_equal(have.status, want.status)
    np.testing.assert_array_equal(fast.status(points), slow.status(points))


def test_distances_are_the_same(ground):
    points = np.concatenate([places(2000), 100.0 + places(10)])
    options = DistanceOptions(4.0, surface_point=True, unknown_distance=True)
    have, want = (distances(view, points, options) for view in ground)
    assert want.found.any()
    assert not want.found.all()
    np.testing.assert_array_equal(have.found, want.found)
    np.testing.assert_array_equal(have.status, want.status)
    np.testing.assert_allclose(have.distance_m, want.distance_m, atol=1e-5)
    np.testing.assert_allclose(have.unknown_distance_m, want.unknown_distance_m, atol=1e-5)
    np.testing.assert_allclose(have.confidence, want.confidence, atol=1e-6)
    gaps = np.linalg.norm(points - have.surface_point, axis=1)
    wanted_gaps = np.linalg.norm(points - want.surface_point, axis=1)
    np.testing.assert_allclose(gaps, wanted_gaps, atol=1e-5)
    along = np.einsum("ij,ij->i", have.gradient, want.gradient)[want.found]
    assert np.quantile(along, 0.01) > 0.99


def test_answers_of_planners_are_the_same(ground):
    fast, slow = ground
    starts, ends = places(60), places(60, seed=1)
    radii = np.random.default_rng(2).uniform(0, 2, 60)
    np.testing.assert_array_equal(
        spheres(fast, starts, radii).status, spheres(slow, starts, radii).status
    )
    ways = (ends - starts) / np.linalg.norm(ends - starts, axis=1, keepdims=True)
    for through in (False, True):
        have, want = (rays(v, starts, ways, RayOptions(15.0, through)) for v in ground)
        np.testing.assert_array_equal(have.status, want.status)
        np.testing.assert_allclose(have.range_m, want.range_m, atol=1e-3)
    have, want = (segments(v, starts, ends, SegmentOptions(0.2, 2.0)) for v in ground)
    for name, value in vars(want).items():
        np.testing.assert_allclose(getattr(have, name), value, atol=1e-3, err_msg=name)
    shape = GridShape(np.array([-3.0, -3.0, -1.0]), 0.5, (12, 12, 4))
    have, want = (grid(view, shape, 3.0) for view in ground)
    np.testing.assert_allclose(have.distance_m, want.distance_m, atol=1e-5)
    np.testing.assert_array_equal(have.status, want.status)


def test_the_ground_is_the_same(ground):
    points = np.concatenate([places(400), 100.0 + places(10)])
    have, want = (ground_below(view, points, 0.7) for view in ground)
    assert set(want.status.tolist()) == set(Status)
    np.testing.assert_array_equal(have.status, want.status)
    np.testing.assert_allclose(have.height_m, want.height_m, atol=1e-3)
    np.testing.assert_allclose(have.confidence, want.confidence, atol=1e-6)
    along = np.einsum("ij,ij->i", have.normal, want.normal)[want.status == Status.SURFACE]
    assert np.quantile(along, 0.01) > 0.99


@given(st.integers(0, 10**6), st.sampled_from([TWO, APART]))
@settings(max_examples=10, deadline=None)
def test_the_blended_field_of_several_regions_is_the_same(seed, indices):
    record = random_record(seed, indices=indices, points=80, training=False)
    points = around(record, 300, seed)
    have, want = (view.query(points, gradient=True) for view in both(record))
    np.testing.assert_allclose(have.sdf, want.sdf, atol=1e-4)
    np.testing.assert_array_equal(have.status, want.status)
    # At the kinks of a random field the last bit tells which side's gradient is taken.
    same = np.isclose(have.gradient, want.gradient, atol=1e-3, equal_nan=True).all(axis=1)
    assert same.mean() > 0.98


@given(st.integers(0, 10**6), st.sampled_from([((0, 0, 0),), TWO, APART]))
@settings(max_examples=10, deadline=None)
def test_maps_of_several_regions_answer_alike(seed, indices):
    record = with_support(random_record(seed, indices=indices, points=80, training=False))
    points = around(record, 300, seed)
    have, want = (distances(v, points, DistanceOptions(6.0)) for v in both(record))
    np.testing.assert_array_equal(have.status, want.status)
    # Where a random field makes a surfel a disc or a point may hang on the last bit.
    same = np.abs(have.distance_m - want.distance_m) < 1e-3
    assert same.mean() > 0.98
    assert (np.abs(have.confidence - want.confidence) < 1e-6)[same].mean() > 0.98


def test_a_map_of_which_nothing_is_known(ground):
    for view in both(MapRecord("empty", 3, SMALL, ())):
        answer = distances(view, places(10), DistanceOptions(2.0, unknown_distance=True))
        assert view.epoch == 3
        assert not answer.found.any()
        assert not answer.status.any()
        assert not answer.unknown_distance_m.any()
        assert np.isnan(view.query(places(10)).sdf).all()


def test_points_far_from_the_map_are_unknown_however_far_apart(ground):
    """Each lies in a cell of its own of the lattice of regions: one after the other is too slow."""
    compiled, _ = ground
    points = np.random.default_rng(1).uniform(-1e8, 1e8, (100_000, 3))
    points[0], points[1] = (5.0, 0.0, 1.0), (1e22, 0.0, 0.0)
    found = compiled.nearest_unknown(points, 100.0)
    assert found.distance[0] > 0.5
    assert not found.distance[1:].any()
    np.testing.assert_array_equal(found.point[1:], points[1:])


def test_no_points_get_no_answers(ground):
    for view in ground:
        answer = distances(view, np.zeros((0, 3)), DistanceOptions(unknown_distance=True))
        assert len(answer.distance_m) == len(answer.gradient) == 0


@pytest.mark.parametrize("reach_m", [0.0, 0.1, 0.35, 0.7])
def test_the_status_is_the_same_however_far_surfaces_reach(ground, reach_m):
    points = places(1000)
    have, want = (view.status(points, reach_m) for view in ground)
    np.testing.assert_array_equal(have, want)


def test_a_closed_map_answers_on_the_callers_thread():
    view = RecordedView(exact_map(flat(0.07)))
    view.close()
    points = places(20_000)
    again = RecordedView(exact_map(flat(0.07)))
    have, want = (v.query(points, gradient=True) for v in (view, again))
    np.testing.assert_array_equal(have.sdf, want.sdf)
    np.testing.assert_array_equal(have.gradient, want.gradient)
    again.close()


def test_surfels_are_fitted_once_however_many_threads_ask(ground):
    """And each of them gets the same answer."""
    view = RecordedView(exact_map(flat(0.0)))
    points = places(3000)
    asked: list[MapView] = [view] * 8
    with ThreadPoolExecutor(8) as threads:
        answers = list(threads.map(lambda v: v.nearest_surface(points, 3.0), asked))
    assert len({id(region.surfels) for region in view.region_views}) == 1
    for answer in answers[1:]:
        np.testing.assert_array_equal(answer.distance, answers[0].distance)
