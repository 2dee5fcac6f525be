import numpy as np
from triquad_tools.recordings.cloud import at_most, merged, points_in_range, world_points
from triquad_tools.sensors.sweep import PosedScan


def test_points_out_of_range_are_left_out() -> None:
    points = np.array([[1, 0, 0], [0, 3, 0], [0, 0, -9], [np.nan, 0, 0]], np.float32)
    np.testing.assert_array_equal(points_in_range(points, 2.0), points[1:3])
    np.testing.assert_array_equal(points_in_range(points, 0.0), points)
    assert points_in_range(points, 2.0).dtype == np.float32


def test_world_points_are_moved_by_the_pose_and_finite() -> None:
    pose = np.eye(4)
    pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    pose[:3, 3] = [100, 0, 5]
    points = np.array([[2, 0, 0], [0.5, 0, 0], [np.inf, 0, 0]], np.float32)
    scan = PosedScan(points, pose)
    np.testing.assert_allclose(world_points(scan), [[100, 2, 5], [100, 0.5, 5]])
    np.testing.assert_allclose(world_points(scan, range_min_m=1.0), [[100, 2, 5]])


def test_merged_clouds_keep_one_point_per_voxel() -> None:
    cloud = np.array([[0.01, 0.01, 0.01], [0.02, 0.01, 0.01], [0.35, 0.0, 0.0]])
    np.testing.assert_array_equal(merged([cloud, cloud + 0.01], 0.1), cloud[[0, 2]])
    assert merged([], 0.1).shape == (0, 3)


def test_too_many_points_are_thinned_evenly() -> None:
    """No pattern of the rays is kept: of 128 lasers, each has its share."""
    points = np.zeros((1_000_000, 3), np.float32)
    points[:, 0], points[:, 1], points[::10, 2] = np.arange(1e6), np.arange(1_000_000) % 128, np.nan
    np.testing.assert_array_equal(at_most(points, 10**6), points)
    thinned = at_most(points, 500_000)
    assert thinned.shape == (500_000, 3)
    assert np.diff(thinned[:, 0]).min() > 0
    assert np.diff(thinned[:, 0]).max() < 8
    of_lasers = np.bincount(thinned[:, 1].astype(int), minlength=128)
    assert of_lasers.min() > 0.9 * 500_000 * 0.8 / 128
    np.testing.assert_array_equal(at_most(points, 950_000), points[np.isfinite(points[:, 2])])
