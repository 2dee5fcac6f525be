import numpy as np
from triquad_tools.recordings.cloud import merged, points_in_range, world_points
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
