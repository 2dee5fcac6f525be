"""Where a robot could stand: the ground of a known place, asked of a real server."""

import math
from collections.abc import Iterator

import numpy as np
import pytest
from support import servers
from support.poses import shifted
from triquad_client import Status
from triquad_server.settings import Settings
from triquad_tools.simulation.lidar import Lidar, SimulatedScan
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import Solid, box, gable, half_space

VOXEL_M = 0.2
SETTINGS = Settings.model_validate(
    {"field": {"depth": 8}, "training": {"batch": 4096, "samples_per_ray": 10.0}}
)


# A place of steps, holes, edges and slopes, and what a robot's lidar sees as it walks there

KERB_M = 0.12
STEP_M = 0.17  # up, and down
TREAD_M = 0.3
RAMP_DEG = 15.0
HOLE_M = 0.6  # deep, both
BELOW_EDGE_M = -3.0
TABLE_M = 0.6  # its top
TABLE_THICK_M = 0.1

_WALL_M = 4.0
_EYE_M = 1.2
_LIDAR = Lidar(columns=540, elevation_min_deg=-60.0, elevation_max_deg=10.0)


def _block(x: tuple[float, float], y: tuple[float, float], top_m: float) -> Solid:
    """A block that is thick enough to stand on whatever lies below."""
    low_m = -3.5
    middle = (sum(x) / 2, sum(y) / 2, (top_m + low_m) / 2)
    return box(middle, ((x[1] - x[0]) / 2, (y[1] - y[0]) / 2, (top_m - low_m) / 2))


def _stairs(north: bool) -> list[Solid]:
    """Five treads from the corridor: up to the north, down to the south."""
    treads = []
    for tread in range(5):
        near, far = 2.0 + TREAD_M * tread, 2.0 + TREAD_M * (tread + 1)
        if north:
            treads.append(_block((-6, -3), (near, 6), STEP_M * (tread + 1)))
        else:
            treads.append(_block((-6, -3), (1.0 - far, 1.0 - near), -STEP_M * (tread + 1)))
    return treads


def _scene() -> Scene:
    rise_m = 3.0 * math.tan(math.radians(RAMP_DEG))
    north = [
        _block((-20, -6), (1, 6), 0.0),
        _block((-20, -6), (2, 6), KERB_M),
        _block((-6, -3), (1, 2), 0.0),
        *_stairs(north=True),
        _block((-3, 2), (1, 8), 0.0),
        gable((-1, 5, (rise_m - 1) / 2), (2, 3, (rise_m + 1) / 2), 1.0),
        _block((2, 5), (1, 2.5), -HOLE_M),  # beside the way: its bottom is seen
        _block((2, 5), (2.5, 6), 0.0),
        _block((5, 20), (1, 6), 0.0),
    ]
    south = [
        _block((-20, -6), (-6, -1), 0.0),
        *_stairs(north=False),
        _block((-6, -3), (-6, -2.5), -5 * STEP_M),
        _block((-3, 2), (-6, -1), 0.0),
        _block((2, 5), (-4.4, -1), 0.0),
        _block((2, 3.2), (-5, -4.4), 0.0),
        _block((3.2, 3.8), (-5, -4.4), -HOLE_M),  # far from it: its bottom is not
        _block((3.8, 5), (-5, -4.4), 0.0),
        _block((2, 5), (-6, -5), 0.0),
        _block((5, 6), (-6, -1), 0.0),  # and from here on there is an edge
    ]
    walls = [
        _block((-21, 21), (8, 9), _WALL_M),
        _block((-21, 5), (-7, -6), _WALL_M),
        _block((5, 21), (-13, -12), _WALL_M),
        _block((-21, -20), (-13, 9), _WALL_M),
        _block((20, 21), (-13, 9), _WALL_M),
    ]
    corridor = _block((-20, 20), (-1, 1), 0.0)
    table = box((8.6, 2.8, TABLE_M - TABLE_THICK_M / 2), (0.6, 0.6, TABLE_THICK_M / 2))
    solids = (half_space(BELOW_EDGE_M), corridor, table, *north, *south, *walls)
    return Scene(solids, np.array([[-21.0, -13, -4], [21, 9, 5]]))


SCENE = _scene()


def walk() -> Iterator[SimulatedScan]:
    """Scans along the corridor, and up and down the stairs."""
    on_stairs = [(2.6, 2), (3.2, 4), (4.2, 5), (-1.45, -2), (-2.05, -4), (-3.2, -5), (-4.2, -5)]
    places = [(x, 0.0, 0.0) for x in np.linspace(-12, 12, 25)]
    places += [(-4.5, y, STEP_M * steps) for y, steps in on_stairs]
    rng = np.random.default_rng(0)
    for x, y, floor in places:
        yield _LIDAR.scan(SCENE, shifted(x, y, floor + _EYE_M), rng)


@pytest.fixture(scope="module")
def client():
    """Of a server to which a robot has shown the place, and that has learnt all of it."""
    with servers.service_and_client(SETTINGS) as client:
        for scan in walk():
            client.publish_scan(scan.points, scan.world_from_sensor)
            client.flush(servers.WAIT_S, pending=2)
        client.flush(servers.WAIT_S)
        client.settle(5 * servers.WAIT_S)
        yield client


def points_over(x, y, z):
    """Points [N, 3] at one height over a rectangle, 5 cm apart."""
    axes = [np.arange(low, high, 0.05) for low, high in (x, y)]
    grid = np.meshgrid(*axes, indexing="ij")
    return np.column_stack([axis.ravel() for axis in (*grid, np.full(grid[0].shape, z))])


def check_ground(answer, height_m, *, within_m=0.03, told=0.98):
    """It is ground at these heights: one for all, or one [N] for each.

    What is learnt differs from run to run: nearly all is right, and nothing is wrong by more than
    a robot stands over.
    """
    stands = answer.status == Status.SURFACE
    assert stands.mean() > told
    error_m = np.abs(answer.height_m - height_m)[stands]
    assert np.quantile(error_m, 0.95) < within_m
    assert error_m.max() < VOXEL_M / 2
    assert (answer.confidence[stands] > 0).all()


def test_a_kerb(client):
    check_ground(client.query_ground(points_over((-11, -7), (1.2, 1.9), 0.5)), 0.0, within_m=0.02)
    check_ground(client.query_ground(points_over((-11, -7), (2.1, 3.5), 0.6)), KERB_M)
    # Not in the face itself, where next to nothing decides what is below.
    across = client.query_ground(points_over((-9, -8.9), (1.525, 2.5), 0.5))
    rises = np.diff(across.height_m.reshape(2, -1), axis=1)
    assert (across.status == Status.SURFACE).mean() > 0.95
    assert (rises > -0.03).all()
    assert np.ptp(across.height_m) == pytest.approx(KERB_M, abs=0.04)


@pytest.mark.parametrize("tread", range(5))
@pytest.mark.parametrize("up", [True, False], ids=["up", "down"])
def test_every_tread_of_the_stairs_has_its_height(client, tread, up):
    height_m = STEP_M * (tread + 1) * (1 if up else -1)
    middle = (2 if up else -1) + (1 if up else -1) * TREAD_M * (tread + 0.5)
    over = points_over((-5.5, -3.5), (middle - 0.05, middle + 0.05), height_m + 0.4)
    # The upper treads of the way down are seen from above alone: 1 to 4.5 cm, from run to run.
    check_ground(client.query_ground(over), height_m, within_m=STEP_M / 3)


def test_the_ground_a_little_above_a_point_counts_and_no_more(client):
    for below_m in (0.0, 0.04, 0.08):
        check_ground(client.query_ground(points_over((-8, 8), (-0.8, 0.8), -below_m)), 0.0)
    for below_m in (0.15, 0.2, 0.3, 0.6):
        buried = client.query_ground(points_over((-8, 8), (-0.8, 0.8), -below_m))
        is_none = buried.status == Status.UNKNOWN
        assert is_none.mean() > 0.99
        assert (buried.height_m[is_none] <= -below_m + 1e-6).all()


def test_a_ramp_has_its_slope(client):
    over = points_over((-2.5, 0.5), (2.3, 4.7), 1.1)
    answer = client.query_ground(over)
    check_ground(answer, np.tan(np.deg2rad(RAMP_DEG)) * (over[:, 1] - 2))
    assert np.median(answer.slope_deg) == pytest.approx(RAMP_DEG, abs=1.5)
    assert np.quantile(np.abs(answer.slope_deg - RAMP_DEG), 0.9) < 6
    assert (answer.normal[:, 1] < -0.15).mean() > 0.9  # it rises along y


def test_a_hole_whose_bottom_is_seen(client):
    bottom = client.query_ground(points_over((2.3, 4.7), (1.6, 2.4), 0.3))
    check_ground(bottom, -HOLE_M)
    shallow = client.query_ground(points_over((2.3, 4.7), (1.6, 2.2), 0.3), max_drop_m=0.7)
    assert (shallow.status == Status.FREE).all()
    np.testing.assert_allclose(shallow.height_m, -0.4, atol=1e-6)


def test_a_hole_whose_bottom_is_not_seen_is_never_ground(client):
    """But within a voxel of its sides, which is as far as the map can tell."""
    inside = points_over((3.42, 3.58), (-4.98 + VOXEL_M, -4.42 - VOXEL_M), 0.3)
    answer = client.query_ground(inside)
    assert (answer.status == Status.UNKNOWN).all()
    assert not answer.normal.any()
    assert not answer.confidence.any()
    assert (answer.slope_deg == 90).all()


def test_over_an_edge_there_is_no_ground(client):
    assert (SCENE.sdf(np.array([[8.0, -1.5, -1]])) > 0).all()
    check_ground(client.query_ground(points_over((7, 11), (-0.95, -0.6), 0.3)), 0.0)
    beyond = points_over((7, 11), (-5, -1 - VOXEL_M), 0.3)
    answer = client.query_ground(beyond)
    assert not (answer.status == Status.SURFACE).any()
    seen = answer.status == Status.FREE
    assert seen.any()
    np.testing.assert_allclose(answer.height_m[seen], 0.3 - 2.0, atol=1e-6)
    assert (answer.height_m[~seen] > 0.3 - 2.0).all()
    bottom = client.query_ground(beyond, max_drop_m=4.0)
    there = bottom.status == Status.SURFACE
    assert there.any()
    off_m = np.abs(bottom.height_m[there] - BELOW_EDGE_M)
    assert np.quantile(off_m, 0.95) < 0.1


def test_far_ground_is_right_where_it_is_told(client):
    """Up to eight metres from the nearest place of the sensor, at eight degrees."""
    for x in ((-19.5, -13), (13, 19.5)):
        answer = client.query_ground(points_over(x, (-0.5, 0.5), 0.4))
        check_ground(answer, 0.0, told=0.8)
        assert (answer.status != Status.FREE).all()


def test_the_first_surface_below_counts(client):
    over = points_over((8.2, 9.0), (2.4, 3.2), 0.9)
    check_ground(client.query_ground(over), TABLE_M)
    # Under the table the ground is seen, from where its underside, which is not, is no longer felt.
    below = over - [0, 0, 0.9 - (TABLE_M - TABLE_THICK_M - 1.5 * VOXEL_M)]
    check_ground(client.query_ground(below), 0.0)


def test_what_lies_below_unseen_space_is_no_ground(client):
    inside_wall = client.query_ground(points_over((-8, 8), (8.2, 8.8), 3.0), max_drop_m=10)
    assert (inside_wall.status == Status.UNKNOWN).all()


def test_where_nothing_was_seen_nothing_is_said(client):
    points = np.array([[0.0, 0, 50], [1e6, 0, 0], [0, -30, 0]])
    answer = client.query_ground(points)
    assert (answer.status == Status.UNKNOWN).all()
    np.testing.assert_allclose(answer.height_m, points[:, 2])


def test_parts_and_the_whole_agree(client):
    points = points_over((-12, 12), (-0.9, 0.9), 0.5)
    assert len(points) > 4_000  # more than one request holds
    whole = client.query_ground(points)
    some = client.query_ground(points[::50])
    np.testing.assert_array_equal(whole.status[::50], some.status)
    np.testing.assert_allclose(whole.height_m[::50], some.height_m, atol=1e-3)
