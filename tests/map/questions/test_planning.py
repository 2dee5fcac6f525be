"""Questions of planners, asked of a real server through the network."""

import numpy as np
import pytest
import triquad_client
from support import servers
from triquad_client import InvalidInputError, Status, Unknown, UnknownSpaceError
from triquad_format.wire.limits import MAX_SEARCHES

RADIUS_M = servers.RADIUS_M
POSE = np.eye(4)


@pytest.fixture(scope="module")
def client():
    """Of a server that has seen a sphere from its middle, and learnt all of it."""
    with servers.service_and_client() as client:
        for turn in range(3):
            client.publish_scan(even_sphere(60_000, turn), POSE, stamp_s=1.7e9)
        client.flush(servers.WAIT_S)
        client.settle(servers.WAIT_S)
        yield client


def even_sphere(count, turn):
    """Points [count, 3] that leave no gaps on the sphere around the sensor."""
    height = 1 - (np.arange(count) + 0.5) * 2 / count
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(count) + turn
    wide = np.sqrt(1 - height**2)
    ball = np.stack([wide * np.cos(angle), wide * np.sin(angle), height], axis=1)
    return (RADIUS_M * ball).astype(np.float32)


def directions(count=500):
    ways = np.random.default_rng(4).normal(size=(count, 3))
    return ways / np.linalg.norm(ways, axis=1, keepdims=True)


def test_distances_are_true_at_any_range(client):
    ways = directions()
    radii = np.random.default_rng(0).uniform(0.5, RADIUS_M - 0.6, (len(ways), 1))
    answer = client.query_distance(radii * ways, surface_point=True)
    assert answer.found.all()
    assert (answer.status == Status.FREE).all()
    error = answer.distance_m - (RADIUS_M - radii[:, 0])
    assert np.abs(error).mean() < 0.03
    assert np.quantile(error, 0.95) < 0.08  # longer than it is: the way a planner would be hurt
    off_centre = radii[:, 0] > 1.0  # in the middle all directions are nearly as near
    assert (np.einsum("ij,ij->i", answer.gradient, -ways)[off_centre] > 0.9).mean() > 0.95
    feet = np.linalg.norm(answer.surface_point, axis=1)
    assert (np.abs(feet - RADIUS_M) < 0.15).mean() > 0.98
    apart = np.linalg.norm(answer.surface_point - radii * ways, axis=1)
    assert (np.abs(apart - answer.distance_m) < 0.05).mean() > 0.98
    assert (answer.confidence > 0).all()


def test_what_lies_farther_than_asked_is_not_found(client):
    answer = client.query_distance([[0.0, 0, 0]], max_distance_m=1.0, surface_point=True)
    assert not answer.found[0]
    assert answer.distance_m[0] == 1.0
    assert not answer.gradient.any()
    assert answer.confidence[0] == 0
    np.testing.assert_array_equal(answer.surface_point, [[0, 0, 0]])


def test_behind_the_surface_the_distance_is_negative(client):
    ways = directions()
    behind = client.query_distance((RADIUS_M + 0.08) * ways)
    assert (behind.distance_m < 0).mean() > 0.95
    before = client.query_distance((RADIUS_M - 0.08) * ways)
    assert (before.distance_m > 0).mean() > 0.95


def test_unknown_space_is_near_where_nothing_was_seen(client):
    outside = (RADIUS_M + 3.0) * directions()
    answer = client.query_distance(outside, unknown_distance=True)
    assert (answer.unknown_distance_m == 0).all()
    assert (answer.status == Status.UNKNOWN).all()
    assert not answer.confidence.any()
    middle = client.query_distance([[0.0, 0, 0]], max_distance_m=6.0, unknown_distance=True)
    assert RADIUS_M - 0.8 < middle.unknown_distance_m[0] < RADIUS_M + 0.8


def test_unknown_space_counts_as_a_planner_wants(client):
    outside = np.array([[0, 0, RADIUS_M + 1.0]])
    assert client.query_distance(outside).distance_m[0] > 0.5
    wary = client.query_distance(outside, unknown="obstacle", surface_point=True)
    assert wary.distance_m[0] == 0
    assert wary.found[0]
    assert wary.confidence[0] == 0
    with pytest.raises(UnknownSpaceError, match="point 0"):
        client.query_distance(outside, unknown=Unknown.ERROR)
    with pytest.raises(InvalidInputError, match="'obstacle', 'free', 'error'"):
        client.query_distance(outside, unknown="maybe")


def test_spheres(client):
    centres = [[0, 0, 0], [0, 0, RADIUS_M - 0.5], [0, 0, RADIUS_M + 3], [2, 0, 0]]
    answer = client.query_spheres(centres, [1.0, 0.8, 0.5, 1.5])
    assert answer.status.tolist() == [
        Status.FREE,
        Status.SURFACE,
        Status.UNKNOWN,
        Status.FREE,
    ]
    assert answer.free().tolist() == [True, False, False, True]
    assert answer.free("free").tolist() == [True, False, True, True]
    with pytest.raises(UnknownSpaceError, match="sphere 2"):
        answer.free("error")


def test_a_ball_meets_the_surface_where_its_radius_says(client):
    ways = directions()
    answer = client.query_segments(np.zeros_like(ways), 6.0 * ways, radius_m=0.5)
    assert answer.blocked.all()
    assert (np.abs(answer.contact_m - (RADIUS_M - 0.5)) < 0.15).mean() > 0.98
    assert (answer.clearance_m <= 0.5 + 1e-3).all()
    assert not answer.free().any()


def test_clearance_along_a_way(client):
    way = client.query_segments([[-2.0, 1, 0]], [[2.0, 1, 0]], radius_m=0.3)
    assert way.free().all()
    expected = RADIUS_M - np.hypot(2, 1)  # at both ends
    np.testing.assert_allclose(way.clearance_m, expected, atol=0.1)
    assert min(way.clearance_at_m[0], 4 - way.clearance_at_m[0]) < 0.2


def test_a_polyline_is_its_segments_one_after_the_other(client):
    corners = [[-1.0, 0, 0], [1.0, 0, 0], [1.0, 0, 6.0], [0, 0, 0]]
    answer = client.query_polyline(corners, radius_m=0.4)
    assert answer.blocked
    assert not answer.free()
    height = np.sqrt(RADIUS_M**2 - 1)
    assert abs(answer.contact_m - (2 + height - 0.4)) < 0.2
    assert answer.length_m == pytest.approx(2 + 6 + np.hypot(1, 6))
    inside = client.query_polyline(corners[:2], radius_m=0.4)
    assert inside.free()
    assert inside.contact_m == inside.length_m


def test_rays_reach_the_surface(client):
    ways = directions()
    start = np.array([0.5, -0.7, 0.3])
    answer = client.query_rays(start, ways * 3.0, max_range_m=20.0)
    assert (answer.status == Status.SURFACE).mean() > 0.95
    hit = answer.status == Status.SURFACE
    ends = start + answer.range_m[:, None] * ways
    assert (np.abs(np.linalg.norm(ends[hit], axis=1) - RADIUS_M) < 0.15).mean() > 0.98


def test_rays_end_where_they_may_go_no_farther(client):
    short = client.query_rays([0.0, 0, 0], [[1.0, 0, 0]], max_range_m=2.0)
    assert short.status[0] == Status.FREE
    assert short.range_m[0] == 2.0
    outside = client.query_rays([0.0, 0, 9.0], [[0, 0, 1.0]])
    assert outside.status[0] == Status.UNKNOWN
    assert outside.range_m[0] == 0
    through = client.query_rays([0.0, 0, 9.0], [[0, 0, 1.0]], 10.0, through_unknown=True)
    assert through.status[0] == Status.FREE


def test_a_slice_shows_the_wall(client):
    low, high = [-6.0, -6.0, 0.0], [6.0, 6.0, 0.0]
    grid = client.query_grid((low, high), cell_m=0.2)
    assert grid.status.shape == (60, 60, 1)
    middles = grid.shape.middles()
    assert (middles[:, 2] == 0).all()
    radius = np.linalg.norm(middles, axis=1).reshape(60, 60, 1)
    assert (grid.status[radius < RADIUS_M - 0.5] == Status.FREE).all()
    assert (grid.status[radius > RADIUS_M + 1] == Status.UNKNOWN).all()
    ring = np.abs(radius - RADIUS_M) < 0.05
    assert (grid.status[ring] == Status.SURFACE).mean() > 0.9
    inside = (radius < 3.5) & (radius > 0.5)
    assert (np.abs(grid.distance_m - (RADIUS_M - radius))[inside] < 0.15).mean() > 0.98


def test_parts_and_the_whole_agree(client):
    points = np.random.default_rng(2).uniform(-5, 5, (45_000, 3))
    whole = client.query_distance(points, unknown_distance=True, surface_point=True)
    some = client.query_distance(points[::100], unknown_distance=True, surface_point=True)
    np.testing.assert_allclose(whole.distance_m[::100], some.distance_m, atol=1e-4)
    np.testing.assert_allclose(whole.surface_point[::100], some.surface_point, atol=1e-3)
    np.testing.assert_allclose(whole.unknown_distance_m[::100], some.unknown_distance_m, atol=1e-4)
    np.testing.assert_array_equal(whole.status[::100], some.status)


def test_a_grid_of_several_requests_is_put_together_right(client):
    grid = client.query_grid(((-6.0, -6, -1), (6.0, 6, 1)), cell_m=0.15)
    assert grid.status.size > 4 * MAX_SEARCHES
    some = client.query_distance(grid.shape.middles()[::501])
    np.testing.assert_array_equal(grid.status.reshape(-1)[::501], some.status)
    np.testing.assert_allclose(grid.distance_m.reshape(-1)[::501], some.distance_m, atol=1e-3)


def test_a_grid_whose_layers_are_too_large_for_one_request(client):
    """Some parts of a layer are smaller than others."""
    grid = client.query_grid(((-1.0, -6, -6), (-0.9, 6, 6)), cell_m=0.08)
    assert grid.shape.counts == (2, 150, 150)
    some = client.query_distance(grid.shape.middles()[::501])
    np.testing.assert_array_equal(grid.status.reshape(-1)[::501], some.status)
    np.testing.assert_allclose(grid.distance_m.reshape(-1)[::501], some.distance_m, atol=1e-3)


def test_no_points_are_no_error(client):
    nothing = client.query_sdf(np.zeros((0, 3)), gradient=True)
    assert (nothing.sdf.shape, nothing.gradient.shape) == ((0,), (0, 3))
    assert nothing.epoch == client.status().epoch
    assert len(client.query_distance(np.zeros((0, 3)), surface_point=True).distance_m) == 0
    assert len(client.query_spheres(np.zeros((0, 3)), 1.0).status) == 0
    assert len(client.query_segments(np.zeros((0, 3)), np.zeros((0, 3))).contact_m) == 0
    assert len(client.query_rays(np.zeros((0, 3)), np.zeros((0, 3))).range_m) == 0
    nowhere = client.query_ground(np.zeros((0, 3)))
    assert len(nowhere.height_m) == len(nowhere.slope_deg) == 0


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda c: c.query_distance([[0, 0, np.nan]]), "point 0 is not finite"),
        (lambda c: c.query_distance([[0.0, 0, 0]], max_distance_m=0), "max_distance_m = 0"),
        (lambda c: c.query_spheres([[0.0, 0, 0]], [1.0, 2.0]), "radii"),
        (lambda c: c.query_spheres([[0.0, 0, 0]], -1.0), "radius 0 is -1"),
        (lambda c: c.query_segments([[0.0, 0, 0]], np.zeros((2, 3))), "1 starts and 2 ends"),
        (lambda c: c.query_segments([[0.0, 0, 0]], [[9e8, 0, 0]]), "segment 0 is 9e\\+08 m long"),
        (lambda c: c.query_polyline([[0, 0, 0], [1, 0, 0], [1002, 0, 0]]), "segment 1 is 1001 m"),
        (lambda c: c.query_polyline([[0.0, 0, 0]]), "a polyline of 1 points"),
        (lambda c: c.query_rays([0, 0, 0], [[0.0, 0, 0]]), "direction 0 .* no length"),
        (lambda c: c.query_rays(np.zeros((2, 3)), np.ones((3, 3))), "2 origins for 3"),
        (lambda c: c.query_ground([[0.0, 0]]), "points are \\[1, 2\\]"),
        (lambda c: c.query_ground([[0.0, 0, 0]], max_drop_m=0), "max_drop_m = 0: use 1e-06 to 100"),
        (lambda c: c.query_ground([[0.0, 0, 0]], max_drop_m=np.nan), "max_drop_m = nan"),
        (lambda c: c.query_ground([[0.0, 0, 0]], "deep"), "max_drop_m = 'deep' is not a number"),
        (lambda c: c.query_ground([[0.0, 0, 0]], 10**400), "max_drop_m = 1000.*000: use 1e-06 to"),
        (lambda c: c.query_ground([[0.0, 0, 0]], -(10**5000)), "max_drop_m = an integer of 16610"),
        (lambda c: c.query_spheres([[0.0, 0, 0]], 10**400), "radii_m are not one number"),
        (lambda c: c.query_rays([[0, 0, 0], [1]], [[0.0, 0, 1]]), "points are not an array"),
        (lambda c: c.query_sdf([[0.0, 0, 0]], at_epoch=10**400), "at_epoch = 1000.*numbered"),
        (lambda c: c.query_grid(([0, 0, 0], [np.inf, 1, 1])), "finite"),
        (lambda c: c.query_grid(([0, 0, 0], [1e4, 1e4, 1e4])), "cells"),
    ],
)
def test_bad_questions_name_what_is_wrong(client, ask, words):
    with pytest.raises(triquad_client.TriquadError, match=words):
        ask(client)


def test_a_scan_finds_its_place(client):
    true = np.eye(4)
    points = even_sphere(20_000, 0.3)
    # A ball looks alike from all sides: what is not seen of the pose is kept, and said.
    guess = true.copy()
    guess[:3, 3] = (0.3, -0.2, 0.1)
    answer = client.align(points, guess)
    assert np.linalg.norm(answer.world_from_sensor[:3, 3]) < 0.05
    assert answer.inlier_share > 0.9
    assert not answer.converged
    assert np.sqrt(np.diag(answer.covariance))[3:].min() > 1.0
    assert np.sqrt(np.diag(answer.covariance))[:3].max() < 0.2
    # More than the server takes in one request: few of them travel.
    dense = client.align(even_sphere(300_000, 0.1), guess)
    assert dense.points < 2300
    assert dense.inlier_share > 0.9
    with pytest.raises(triquad_client.InvalidInputError, match="not rigid"):
        client.align(points, 2 * true)


def test_answers_do_not_hang_on_what_else_is_asked(client):
    """Places on the faces of voxels, as people type them."""
    places = np.round(np.random.default_rng(6).uniform(-5, 5, (300, 3)), 1)
    ways = np.tile([1.0, 0, 0], (len(places), 1))
    together = client.query_rays(places, ways, max_range_m=20.0)
    status = client.query_spheres(places, 0.3).status
    for i in range(0, len(places), 10):
        alone = client.query_rays(places[i], ways[:1], max_range_m=20.0)
        assert alone.status[0] == together.status[i]
        assert alone.range_m[0] == pytest.approx(together.range_m[i], abs=1e-3)
        assert client.query_spheres(places[i : i + 1], 0.3).status[0] == status[i]
