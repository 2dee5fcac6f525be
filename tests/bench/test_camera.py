import numpy as np
import pytest
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import box, half_space

from bench.scenes.camera import DepthCamera, looking_at

SMALL = DepthCamera(columns=64, rows=48)
QUIET = DepthCamera(columns=64, rows=48, noise_m=0.0, noise_per_m=0.0)
BOUNDS = np.array([[-9.0] * 3, [9.0] * 3])
AHEAD = looking_at(np.array([[0.0, 0.0, 1.0]]), np.array([[5.0, 0.0, 1.0]]))[0]


def wall(distance_m: float) -> Scene:
    """A wall that the camera at the origin looks at."""
    return Scene((box((distance_m + 0.5, 0.0, 0.0), (0.5, 50.0, 50.0)),), BOUNDS)


def test_a_wall_ahead_has_one_depth_and_lies_where_it_stands() -> None:
    scan = QUIET.scan(wall(2.0), AHEAD, np.random.default_rng(0))
    assert len(scan.points) == 64 * 48
    np.testing.assert_allclose(scan.points[:, 2], 2.0, atol=1e-6)
    world = scan.points @ AHEAD[:3, :3].T + AHEAD[:3, 3]
    np.testing.assert_allclose(world, scan.true_hits, atol=1e-5)
    np.testing.assert_allclose(scan.true_hits[:, 0], 2.0, atol=1e-7)


def test_the_frame_is_the_optical_one() -> None:
    right, down, forward = AHEAD[:3, :3].T
    np.testing.assert_allclose([right, down, forward], [[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    ground = Scene((half_space(0.0),), BOUNDS)
    scan = QUIET.scan(ground, AHEAD, np.random.default_rng(0))
    np.testing.assert_allclose(scan.points[:, 1], 1.0, atol=1e-5)  # the ground is below


@pytest.mark.parametrize(("depth_m", "deviation_m"), [(0.5, 0.001375), (2.0, 0.007), (5.0, 0.0385)])
def test_noise_grows_with_the_square_of_the_depth(depth_m: float, deviation_m: float) -> None:
    scan = SMALL.scan(wall(depth_m), AHEAD, np.random.default_rng(1))
    assert np.std(scan.points[:, 2] - depth_m) == pytest.approx(deviation_m, rel=0.05)
    rays = scan.points[:, :2] / scan.points[:, 2:]  # the noise is along the rays
    quiet = QUIET.scan(wall(depth_m), AHEAD, np.random.default_rng(1)).points
    np.testing.assert_allclose(rays, quiet[:, :2] / quiet[:, 2:], atol=1e-5)


@pytest.mark.parametrize("distance_m", [0.2, 8.5])
def test_what_is_too_near_or_too_far_gives_no_pixel(distance_m: float) -> None:
    scan = QUIET.scan(wall(distance_m), AHEAD, np.random.default_rng(0))
    assert len(scan.points) == len(scan.true_hits) == len(scan.no_return) == 0
