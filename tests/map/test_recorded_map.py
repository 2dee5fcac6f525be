"""A map record answers by compiled code; the nearest surfel is that of all."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.maps.exact_maps import exact_map, flat
from support.maps.map_records import SMALL
from triquad_format.records.region import MapRecord
from triquad_map.compiled.team import in_one
from triquad_map.composition.composed_view import ComposedView, RecordedView
from triquad_map.composition.recorded_region import RecordedRegion
from triquad_map.evidence.live_evidence import LiveEvidence
from triquad_map.questions.distance import distances
from triquad_map.surface import DISC_RADIUS, SMOOTHING, SurfelKind, Surfels
from triquad_map.surfels.surfel_search import find_nearest, no_surfels
from triquad_map.surfels.surfel_tree import surfel_places, surfel_tree
from triquad_map.view import MapView


@given(st.integers(0, 10**6), st.integers(0, 300), st.floats(0.3, 80.0))
@settings(max_examples=40)
def test_the_nearest_surfel_is_the_same(seed, count, reach):
    rng = np.random.default_rng(seed)
    live = LiveEvidence(64)
    live.mark("surface", rng.uniform(0, 64, (count, 3)) * (1, 1, 0.3))
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
    """What the search finds, and what comes out where each point is compared with each surfel."""
    fast, slow = (no_surfels(np.full(len(points), reach)) for _ in range(2))
    find_nearest(points, surfel_tree(places.shape, places.voxels(), surfels), fast)
    for i, point in enumerate(points):
        compare_all(i, point, places.voxels(), surfels, slow)
    return fast, slow


def compare_all(i, point, voxels, surfels, found):
    kept = np.flatnonzero(surfels.kinds != SurfelKind.NONE)
    if not len(kept):
        return
    middles, normals = voxels[kept] + 0.5 + surfels.offsets[kept], surfels.normals[kept]
    heights = ((point - middles) * normals).sum(axis=1, keepdims=True)
    beside = point - middles - heights * normals
    lengths = np.linalg.norm(beside, axis=1, keepdims=True)
    within = beside * np.minimum(1.0, DISC_RADIUS / np.maximum(lengths, 1e-9))
    is_disc = np.isin(surfels.kinds[kept], (SurfelKind.DISC, SurfelKind.RAY_DISC))
    closest = middles + np.where(is_disc[:, None], within, 0.0)
    distances = np.linalg.norm(point - closest, axis=1)
    best = distances.argmin()
    if distances[best] < found.distances[i]:
        weights = np.maximum(1.0 - (distances - distances[best]) / SMOOTHING, 0.0) ** 2
        found.distances[i], found.closest[i] = distances[best], closest[best]
        found.means[i] = weights @ closest / weights.sum()
        found.rows[i] = kept[best]


@pytest.mark.parametrize("reach", [30.0, 1e4])
def test_the_nearest_surfel_is_the_same_where_surfaces_are_far_apart(reach):
    rng = np.random.default_rng(7)
    live = LiveEvidence(4096)
    middles = rng.uniform(100, 3996, (12, 3))
    live.mark("surface", middles[rng.integers(12, size=3000)] + rng.uniform(-6, 6, (3000, 3)))
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
    live.mark("surface", middle + 25.0 * directions)  # as seen from inside a ball
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


def random_surfels(rng, count):
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Surfels(
        rng.uniform(-0.5, 0.5, (count, 3)).astype(np.float32),
        normals.astype(np.float32),
        rng.integers(0, len(SurfelKind), count).astype(np.uint8),
    )


def places(count, seed=0):
    return np.random.default_rng(seed).uniform([-14, -14, -2], [14, 14, 6], (count, 3))


def test_a_map_of_which_nothing_is_known():
    with closing(RecordedView(MapRecord("empty", 3, SMALL, ()))) as view:
        answer = distances(view, places(10), 2.0, unknown_distance=True)
        assert view.epoch == 3
        assert not answer.found.any()
        assert not answer.status.any()
        assert not answer.unknown_distance_m.any()
        assert np.isnan(view.query(places(10)).sdf).all()


def test_points_far_from_the_map_are_unknown_however_far_apart():
    """Each lies in a cell of its own of the lattice of regions: one after the other is too slow."""
    points = np.random.default_rng(1).uniform(-1e8, 1e8, (100_000, 3))
    points[0], points[1] = (5.0, 0.0, 1.0), (1e22, 0.0, 0.0)
    with closing(RecordedView(exact_map(flat(0.07)))) as view:
        found = view.nearest_unknown(points, 100.0)
    assert found.distance[0] > 0.5
    assert not found.distance[1:].any()
    np.testing.assert_array_equal(found.point[1:], points[1:])


def test_a_closed_map_answers_on_the_callers_thread():
    view = RecordedView(exact_map(flat(0.07)))
    view.close()
    points = places(20_000)
    again = RecordedView(exact_map(flat(0.07)))
    have, want = (v.query(points, gradient=True) for v in (view, again))
    np.testing.assert_array_equal(have.sdf, want.sdf)
    np.testing.assert_array_equal(have.gradient, want.gradient)
    again.close()


def test_surfels_are_fitted_once_however_many_threads_ask():
    """And each of them gets the same answer."""
    view = RecordedView(exact_map(flat(0.0)))
    points = places(3000)
    asked: list[MapView] = [view] * 8
    with ThreadPoolExecutor(8) as threads:
        answers = list(threads.map(lambda v: v.nearest_surface(points, 3.0), asked))
    everywhere = np.full(3, -np.inf), np.full(3, np.inf)
    (region,) = view.region_views
    first, again = (region.surfels_between(*everywhere) for _ in range(2))
    assert list(map(id, first)) == list(map(id, again))
    for answer in answers[1:]:
        np.testing.assert_array_equal(answer.distance, answers[0].distance)


def test_it_makes_no_difference_in_what_cubes_surfels_are_fitted():
    points, record = places(3000), exact_map(flat(0.02))
    (region,) = record.regions
    whole, cubes = (RecordedRegion(record, region, in_one, side) for side in (None, 16))
    views = [ComposedView(1, record.settings, [one]) for one in (whole, cubes)]
    everywhere = np.full(3, -np.inf), np.full(3, np.inf)
    assert len(whole.surfels_between(*everywhere)) == 1
    near = cubes.surfels_between(np.full(3, -0.5), np.full(3, 0.5))
    assert 0 < len(near) < len(cubes.surfels_between(*everywhere))
    want, have = (view.nearest_surface(points, 3.0) for view in views)
    for name in ("found", "distance", "confidence", "learnt"):
        np.testing.assert_array_equal(getattr(have, name), getattr(want, name))
