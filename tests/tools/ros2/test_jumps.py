"""Where the frame of odometry jumps, scans move by the share of the way that they have behind."""

import numpy as np
from numpy.typing import NDArray
from support.poses import shifted
from triquad_client import Pose
from triquad_format.records.pose import quaternion_of
from triquad_tools.ros2.intake.frame_jumps import FrameJumps
from triquad_tools.ros2.intake.source_poses import Jump, SourcePoses
from triquad_tools.sensors.motion.track import STATIC, Transform

S = 10**9
Matrix = NDArray[np.float64]


def transform(seconds: float | None, pose: Matrix, child: str = "odom") -> Transform:
    turn = tuple(quaternion_of(pose[:3, :3]).tolist())
    stamp_ns = STATIC if seconds is None else round(seconds * S)
    return Transform("map", child, stamp_ns, Pose(tuple(pose[:3, 3].tolist()), turn))


def turned(degrees: float, x: float = 0.0, y: float = 0.0) -> Matrix:
    pose, angle = shifted(x=x, y=y), np.radians(degrees)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return pose


class Jumps:
    """What is found with each transform, at once."""

    def __init__(self) -> None:
        self._found = FrameJumps(wait_s=0.0)

    def add(self, transform: Transform, map_from_robot: Matrix) -> Jump | None:
        self._found.add(transform, map_from_robot, now_s=0.0)
        return next(iter(self._found.due(now_s=0.0)), None)


def test_a_jump_waits_until_scans_of_before_are_published() -> None:
    jumps = FrameJumps(wait_s=2.0)
    for number in range(2):
        jumps.add(transform(number, shifted(x=5.0 * number)), shifted(x=30.0), now_s=10.0 + number)
    assert not jumps.due(12.9)
    assert len(jumps.due(13.0)) == 1
    assert not jumps.due(14.0)


def test_a_jump_is_found_and_what_follows_a_robot_is_not() -> None:
    jumps, here = Jumps(), shifted(x=30.0)
    assert jumps.add(transform(None, shifted(x=9.0)), here) is None
    for number in range(10):
        assert jumps.add(transform(0.1 * number, shifted(x=0.02 * number)), here) is None
    assert jumps.add(transform(1.0, shifted(x=5.0), "base_link"), here) is None
    found = jumps.add(transform(1.0, turned(2.0, x=0.18)), here)
    assert found is not None
    assert found.until_ns == round(0.9 * S)
    np.testing.assert_allclose(found.move @ shifted(x=0.18), turned(2.0, x=0.18), atol=1e-12)
    assert jumps.add(transform(1.1, turned(2.0, x=0.18)), here) is None


def test_another_drive_begins_with_no_jump() -> None:
    jumps, here = Jumps(), np.eye(4)
    jumps.add(transform(100.0, shifted(x=5.0)), here)
    assert jumps.add(transform(3.0, np.eye(4)), here) is None


def test_a_slam_that_follows_tracks_which_slip_in_a_turn_closes_no_loop() -> None:
    jumps, odom = Jumps(), np.eye(4)
    jumps.add(transform(-0.1, shifted(x=0.01)), odom)
    for number in range(40):
        slipped = turned(-0.6 * number)  # of each turn by 3 degrees
        found = jumps.add(transform(0.1 * number, odom), odom @ turned(3.0 * number))
        assert found is None, number
        odom = slipped if number % 8 == 7 else odom
    found = jumps.add(transform(4.1, turned(15.0) @ odom), odom @ turned(120.0))
    assert found is not None


def test_a_loop_may_be_closed_soon_by_what_does_not_follow() -> None:
    jumps = Jumps()
    for number in range(5):
        assert jumps.add(transform(number, np.eye(4)), shifted(x=float(number))) is None
    assert jumps.add(transform(5.0, shifted(y=1.0)), shifted(x=5.0)) is not None


def driven(count: int = 41) -> SourcePoses:
    """A robot that went 40 m along x, a metre each second."""
    poses = SourcePoses()
    for number in range(count):
        poses.add(number * S, shifted(x=float(number)))
    return poses


def wanted(poses: SourcePoses) -> Matrix:
    found = poses.to_correct()
    assert found is not None
    return found.world_from_sensor[:, :3, 3]


def test_what_drifted_is_spread_along_the_way() -> None:
    poses = driven()
    poses.jump(Jump(40 * S, shifted(y=2.0)))
    places = wanted(poses)
    np.testing.assert_allclose(places[:, 1], 2.0 * places[:, 0] / 40.0, atol=1e-9)
    assert places[-1, 1] == 2.0


def test_scans_after_the_jump_stay() -> None:
    poses = driven()
    poses.jump(Jump(30 * S, shifted(y=2.0)))
    found = poses.to_correct()
    assert found is not None
    assert found.stamps_ns[-1] == 30 * S
    np.testing.assert_allclose(found.world_from_sensor[-1, :3, 3], [30.0, 2.0, 0.0])


def test_the_next_jump_moves_what_came_since() -> None:
    poses = driven()
    poses.jump(Jump(20 * S, shifted(y=1.0)))
    poses.jump(Jump(40 * S, shifted(z=2.0)))
    places = wanted(poses)
    assert places[:, 2][places[:, 0] <= 20.0].max() == 0.0
    assert places[-1].tolist() == [40.0, 0.0, 2.0]


def test_jumps_shortly_after_each_other_are_one() -> None:
    poses = driven()
    poses.jump(Jump(39 * S, shifted(y=1.0)))
    poses.jump(Jump(40 * S, shifted(y=1.0)))
    places = wanted(poses)
    np.testing.assert_allclose(places[:36, 1], 2.0 * places[:36, 0] / 40.0, atol=0.05)


def test_a_turn_is_about_the_place_where_the_loop_closed() -> None:
    poses = driven()
    place, turn = shifted(x=40.0), turned(6.0)
    poses.jump(Jump(40 * S, place @ turn @ np.linalg.inv(place)))
    places = wanted(poses)
    np.testing.assert_allclose(places[-1], [40.0, 0.0, 0.0], atol=1e-9)
    assert np.abs(places[:, 0] - np.arange(41 - len(places), 41)).max() < 0.1
    assert 0.5 < np.abs(places[:, 1]).max() < 1.5
