import numpy as np
import pytest
from triquad_server.errors import ScanRefusedError
from triquad_server.intake.scan import usable_rays
from triquad_server.settings import ScanSettings

SETTINGS = ScanSettings()


def pose(**changes: object) -> np.ndarray:
    matrix = np.eye(4)
    for key, value in changes.items():
        matrix[int(key[1]), int(key[2])] = value
    return matrix


def points(*rows: tuple[float, float, float]) -> np.ndarray:
    return np.array(rows, np.float32)


def test_points_are_turned_into_the_map_frame() -> None:
    turn = pose(m00=0, m01=-1, m10=1, m11=0, m03=100, m13=200, m23=5)
    rays = usable_rays(points((10, 0, 0), (0, 20, -1)), turn, SETTINGS)
    np.testing.assert_allclose(rays.origin, [100, 200, 5])
    np.testing.assert_allclose(rays.ends, [[100, 210, 5], [80, 200, 4]])


def test_unusable_points_are_dropped_and_counted_by_reason() -> None:
    scan = points((5, 0, 0), (np.nan, 0, 0), (0, np.inf, 0), (0.1, 0, 0), (60, 0, 0), (3e38, 0, 0))
    rays = usable_rays(scan, pose(), SETTINGS)
    assert len(rays.ends) == 1
    assert rays.points_dropped == {"not_finite": 2, "too_near": 1, "too_far": 2}


def test_scans_are_thinned() -> None:
    rng = np.random.default_rng(0)
    dense = rng.uniform([5, -1, 0], [5.001, 1, 2], (50_000, 3)).astype(np.float32)
    rays = usable_rays(dense, pose(), SETTINGS)
    assert 1500 <= len(rays.ends) <= 1800, "one of 40 x 40 voxels, borders apart"


@pytest.mark.parametrize(
    ("reason", "scan", "at"),
    [
        ("pose_shape", points((5, 0, 0)), np.eye(3)),
        ("pose_not_finite", points((5, 0, 0)), pose(m03=np.nan)),
        ("pose_not_rigid", points((5, 0, 0)), pose(m00=1.2)),
        ("pose_not_rigid", points((5, 0, 0)), pose(m22=-1)),
        ("pose_not_rigid", points((5, 0, 0)), pose(m01=1e200)),
        ("pose_not_rigid", points((5, 0, 0)), pose(m30=1)),
        ("outside_world", points((5, 0, 0)), pose(m03=5e5)),
        ("points_shape", np.zeros((4, 2), np.float32), pose()),
        ("empty", np.zeros((0, 3), np.float32), pose()),
        ("empty", np.full((10, 3), np.nan, np.float32), pose()),
        ("too_many_points", np.zeros((500_001, 3), np.float32), pose()),
    ],
)
def test_refusals_name_their_reason(reason: str, scan: np.ndarray, at: np.ndarray) -> None:
    with pytest.raises(ScanRefusedError) as refusal:
        usable_rays(scan, at, SETTINGS)
    assert refusal.value.reason == reason
    assert len(str(refusal.value)) > 20


def test_poses_with_six_digits_are_rigid_enough() -> None:
    turn = np.round(pose(m00=0.651617, m01=-0.758549, m10=0.758549, m11=0.651617), 5)
    assert len(usable_rays(points((5, 0, 0)), turn, SETTINGS).ends) == 1


def test_returns_at_the_sensor_itself_are_dropped() -> None:
    points = np.array([[0.0, 0, 0], [5, 0, 0], [0, 0, 0]], np.float32)
    rays = usable_rays(points, np.eye(4), ScanSettings(range_min_m=0.0))
    np.testing.assert_array_equal(rays.ends, [[5, 0, 0]])
    assert rays.points_dropped == {"too_near": 2}
