import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from triquad_server.errors import ScanRefusedError
from triquad_server.intake.rays import RobotBox, usable_rays
from triquad_server.settings import ScanSettings, SourceSettings

SETTINGS = ScanSettings()
BY_DIRECTION = ScanSettings(thin_by="direction")


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


def test_what_is_kept_of_a_noisy_wall_is_as_noisy_as_the_wall() -> None:
    rng = np.random.default_rng(0)
    y, z = np.meshgrid(np.arange(-0.5, 0.5, 0.005), np.arange(-0.5, 0.5, 0.005))
    rays = np.stack([np.full(y.size, 4.0), y.ravel(), z.ravel()], axis=-1)
    sent = rays * rng.normal(1.0, 0.01, (len(rays), 1))
    kept = usable_rays(sent.astype(np.float32), pose(), BY_DIRECTION).ends
    assert len(kept) < len(sent) / 50
    assert np.std(kept[:, 0]) == pytest.approx(0.04, rel=0.1)  # voxels make it 1.7 times as much
    assert np.mean(kept[:, 0]) == pytest.approx(4.0, abs=0.005)


def test_what_lies_well_behind_something_else_is_kept() -> None:
    fence, wall = points((5, 0, 0), (5, 1, 0)), points((7, 0, 0), (7, 1.4, 0))
    rays = usable_rays(np.concatenate([fence, wall, fence]), pose(), BY_DIRECTION)
    np.testing.assert_array_equal(rays.ends, np.concatenate([fence, wall]))


@pytest.mark.parametrize(
    ("reason", "scan", "at"),
    [
        ("pose_shape", points((5, 0, 0)), np.eye(3)),
        ("pose_not_finite", points((5, 0, 0)), pose(m03=np.nan)),
        ("pose_not_rigid", points((5, 0, 0)), pose(m00=1.2)),
        ("pose_not_rigid", points((5, 0, 0)), pose(m22=-1)),
        ("pose_not_rigid", points((5, 0, 0)), pose(m01=1e200)),
        ("pose_not_rigid", points((5, 0, 0)), pose(m30=1)),
        ("outside_world", points((5, 0, 0)), pose(m03=5e9)),
        ("points_shape", np.zeros((4, 2), np.float32), pose()),
        ("empty", np.zeros((0, 3), np.float32), pose()),
        ("empty", np.full((10, 3), np.nan, np.float32), pose()),
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


def test_of_a_scan_with_too_many_rays_an_even_part_is_used() -> None:
    at = np.arange(1_000)
    ring = 20 * np.stack([np.cos(at / 100), np.sin(at / 100), 0 * at], 1).astype(np.float32)
    few = SETTINGS.model_copy(update={"max_points": 400})
    rays = usable_rays(ring, pose(), few, no_return=points(*np.eye(3)))
    assert len(rays.open_ends) == 1
    nearest = np.linalg.norm(ring[:, None] - rays.ends, axis=2).argmin(axis=0)
    np.testing.assert_array_equal(nearest // 3, np.arange(334))
    assert rays.points_dropped == {"too_many": 1_003 - 334 - 1}


def test_rays_that_begin_off_their_frame_are_those_of_the_sensor_there() -> None:
    turn = pose()
    turn[:3, :3] = Rotation.from_euler("xyz", [0.2, -0.3, 0.9]).as_matrix()
    there = turn.copy()
    there[:3, 3] += turn[:3, :3] @ (0.5, 0.2, 1.8)
    scan = np.random.default_rng(0).normal(size=(200, 3)) * 9
    box = np.array([[-2.0, -1, -1.8], [2, 1, 1]])
    settings = {"ray_origin_m": (0.5, 0.2, 1.8), "robot_box_m": box + (0.5, 0.2, 1.8)}
    base = usable_rays(
        (scan + (0.5, 0.2, 1.8)).astype(np.float32),
        turn,
        SETTINGS,
        source=SourceSettings(**settings),
    )
    sensor = usable_rays(
        scan.astype(np.float32), there, SETTINGS, source=SourceSettings(robot_box_m=box)
    )
    np.testing.assert_allclose(base.origin, sensor.origin, atol=1e-12)
    np.testing.assert_allclose(base.ends, sensor.ends, atol=1e-5)
    assert base.points_dropped == sensor.points_dropped
    np.testing.assert_allclose(base.robot.corners, sensor.robot.corners, atol=1e-12)


def test_points_on_the_robot_are_told_from_near_ones() -> None:
    source = SourceSettings(robot_box_m=((-2, -1, -1), (3, 1, 1)))
    scan = points((2.9, 0.9, 0.9), (0.2, 0, 0), (0, 1.2, 0), (0, 0, 0), (3.1, 0, 0), (-2, 0, 0))
    rays = usable_rays(scan, pose(), SETTINGS, source=source)
    np.testing.assert_allclose(rays.ends, [[3.1, 0, 0]], atol=1e-6)
    assert rays.points_dropped == {"on_robot": 3, "too_near": 1, "no_range": 1}


def test_the_voxels_of_a_turned_robot_are_those_whose_centres_it_holds() -> None:
    turn = pose()
    turn[:3, :3] = Rotation.from_euler("xyz", [0.2, -0.3, 0.9]).as_matrix()
    turn[:3, 3] = 812.3, -41.7, 3.9
    low, high = np.array([-1.0, -0.5, -0.4]), np.array([0.7, 0.6, 0.2])
    centres = RobotBox(low, high, turn).voxel_centres(0.1)
    every = np.stack(np.meshgrid(*[np.arange(-25, 25)] * 3), -1).reshape(-1, 3)
    every = (np.floor(turn[:3, 3] / 0.1) + every + 0.5) * 0.1
    in_box = (every - turn[:3, 3]) @ turn[:3, :3]
    held = every[((in_box >= low) & (in_box <= high)).all(axis=1)]
    assert len(held) > 500

    def voxels(places: np.ndarray) -> set[tuple[int, ...]]:
        return {tuple(voxel) for voxel in np.floor(places / 0.1).astype(int).tolist()}

    assert voxels(centres) == voxels(held)
