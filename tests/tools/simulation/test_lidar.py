import math

import numpy as np
import pytest
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive, drive
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import box, half_space, sphere
from triquad_tools.simulation.street import street

SMALL = Lidar(beams=32, columns=180)
QUIET = Lidar(beams=32, columns=180, noise_m=0.0)


@pytest.fixture(scope="module")
def world() -> Scene:
    return street(5, length_m=40.0)


def _to_world(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    return points.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]


def test_ranges_to_simple_solids_are_right() -> None:
    solids = (
        half_space(0.0),
        box((10.0, 0.0, 5.0), (2.0, 3.0, 4.0)),
        sphere((0.0, 8.0, 2.0), 1.5),
    )
    scene = Scene(solids, np.array([[-20.0] * 3, [20.0] * 3]))
    directions = np.array(
        [
            [1.0, 0.0, 0.0],  # the box
            [0.0, 1.0, 0.0],  # the ball
            [0.0, 0.0, -1.0],  # the ground
            [-0.6, 0.0, -0.8],
            [0.0, 0.0, 1.0],  # nothing
            [-1.0, 0.0, 0.0],  # along the ground, nothing
        ]
    )
    ranges = scene.cast(np.array([0.0, 0.0, 2.0]), directions, 50.0)
    np.testing.assert_allclose(ranges, [8.0, 6.5, 2.0, 2.5, math.inf, math.inf], atol=1e-7)


def test_hits_lie_on_the_surface_and_points_match_them(world: Scene) -> None:
    pose = drive(world, 5, 4.0)[3]
    scan = QUIET.scan(world, pose, np.random.default_rng(0))
    assert np.abs(world.sdf(scan.true_hits)).max() < 1e-6
    np.testing.assert_allclose(_to_world(scan.points, pose), scan.true_hits, atol=1e-4)


def test_every_ray_hits_something_or_is_told_to_have_met_nothing(world: Scene) -> None:
    pose = drive(world, 5, 4.0)[3]
    scan = QUIET.scan(world, pose, np.random.default_rng(0))
    assert len(scan.points) + len(scan.no_return) == len(QUIET.directions)
    assert len(scan.no_return) > 100
    rays = scan.no_return.astype(np.float64) @ pose[:3, :3].T
    assert np.isinf(world.cast(pose[:3, 3], rays, QUIET.range_max_m - 0.1)).all()


def test_range_noise_has_the_stated_deviation(world: Scene) -> None:
    pose = drive(world, 1, 1.0)[0]
    scan = SMALL.scan(world, pose, np.random.default_rng(2))
    measured = np.linalg.norm(scan.points, axis=1)
    errors = measured - np.linalg.norm(scan.true_hits - pose[:3, 3], axis=1)
    assert np.std(errors) == pytest.approx(0.01, rel=0.05)
    assert abs(np.mean(errors)) < 0.001


def test_drive_is_rigid_and_goes_forward_in_free_space(world: Scene) -> None:
    poses = drive(world, 120, 1.0)  # there and back again
    rotations, positions = poses[:, :3, :3], poses[:, :3, 3]
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (120, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0)
    assert world.sdf(positions).min() > 0.5
    steps = np.diff(positions, axis=0)
    forward = np.einsum("ni,ni->n", steps, rotations[:-1, :, 0])
    assert forward.min() > 0.5
    lengths = np.linalg.norm(steps, axis=1)
    assert lengths.min() > 0.7
    assert lengths.max() < 1.4
    assert positions[:, 0].max() < 45.0
    tilt = np.degrees(np.arccos(rotations[:, 2, 2]))
    assert 0.5 < tilt.max() < 2.5


def test_simulated_drive_repeats_itself_exactly(world: Scene) -> None:
    poses = drive(world, 3, 2.0)
    first, second = (SimulatedDrive(world, SMALL, poses, seed=7) for _ in range(2))
    assert len(first) == 3
    assert len(list(first)) == 3
    np.testing.assert_array_equal(first.scan(2).points, second.scan(2).points)
    assert not np.array_equal(
        first.scan(2).points, SimulatedDrive(world, SMALL, poses, seed=8).scan(2).points
    )
