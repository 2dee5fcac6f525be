"""Where rays begin: clouds that nobody can have seen from there are told, and can be put right."""

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import hall
from support.poses import shifted
from support.recordings.bags import Recorded, messages_for, write_bag
from support.ros_messages import CLOUD, TF
from triquad_format.records.plausibility import hidden_share
from triquad_tools.console.command import ToolError
from triquad_tools.recordings.arguments import add_recording
from triquad_tools.recordings.opening import Selection, open_recording, open_selected
from triquad_tools.recordings.recording import ReadingOptions
from triquad_tools.sensors.ray_check import without_repeated

UP = np.array([0.4, 0, 1.7])  # the lidar on the robot's base, which is on the ground
STAMPS = [1_700_000_000 * 10**9 + i * 10**8 for i in range(9)]
ROS2 = messages_for("mcap")


def base(number: int) -> np.ndarray:
    turn, pose = 0.1 * number, np.eye(4)
    pose[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    pose[:3, 3] = 3 * number, 0.2 * number, 0
    return pose


def seen_from(pose: np.ndarray) -> np.ndarray:
    """What a lidar of 32 beams on the base sees of the hall, points [N, 3] in the base's frame."""
    return hall.seen(hall.lidar_rays(), pose @ shifted(*UP)) + UP


def in_frame(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    return (points @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)


def recorded(
    frame: str, written: Callable[[np.ndarray], np.ndarray] = np.asarray, *, name: str = ""
) -> Iterator[Recorded]:
    """A drive whose clouds are in the frame of the lidar, of the base or of the map."""
    lidar = shifted(*UP)
    yield Recorded("/tf_static", TF, STAMPS[0] - 1, ROS2.tf(0, ("base_link", "lidar", lidar)))
    for number, stamp in enumerate(STAMPS):
        pose = base(number)
        moved = {"lidar": np.linalg.inv(lidar), "base_link": np.eye(4), "camera_init": pose}[frame]
        cloud = ROS2.cloud(in_frame(seen_from(pose), moved), stamp, name or frame)
        yield Recorded(
            "/tf", TF, stamp, ROS2.tf(stamp, ("camera_init", "base_link", written(pose)))
        )
        yield Recorded("/points", CLOUD, stamp + 1, cloud)


def selected(path: Path, *arguments: str) -> Selection:
    parser = argparse.ArgumentParser()
    add_recording(parser)
    return open_selected(parser.parse_args([str(path), *arguments]))


def assert_right(selection: Selection) -> None:
    """Rays begin at the lidar, and end where it saw something."""
    assert len(selection) == len(STAMPS)
    for number, scan in enumerate(selection.scans()):
        pose = base(number)
        np.testing.assert_allclose(scan.world_from_sensor[:3, 3], in_frame(UP, pose), atol=1e-5)
        ends = in_frame(scan.points, scan.world_from_sensor)
        np.testing.assert_allclose(ends, in_frame(seen_from(pose), pose), atol=1e-4)


def test_clouds_in_the_frame_of_the_lidar_are_taken_as_they_are(tmp_path: Path) -> None:
    assert_right(selected(write_bag(tmp_path / "bag", "mcap", recorded("lidar"))))


def test_clouds_in_the_frame_of_the_base_need_the_place_of_the_lidar(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", "mcap", recorded("base_link"))
    recording = open_recording(bag, ReadingOptions())
    assert not recording.entries
    (remark,) = recording.remarks
    assert "/points: 9 of 9 are left out: " in remark
    assert "--ray-origin X,Y,Z" in remark
    assert_right(selected(bag, "--ray-origin", "0.4,0,1.7"))
    assert len(selected(bag, "--ray-origin", "0,0,0")) == len(STAMPS), "who says so is believed"


def test_clouds_in_the_frame_of_the_map_need_a_body_that_saw_them(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", "mcap", recorded("camera_init"))
    recording = open_recording(bag, ReadingOptions())
    assert not recording.entries
    (remark,) = recording.remarks
    assert "camera_init, which stands still in the map while base_link moves" in remark
    assert "--points-in world" in remark
    assert_right(selected(bag, "--points-in", "world", "--ray-origin", "0.4,0,1.7"))
    assert_right(selected(bag, "--points-in", "world", "--body-frame", "lidar"))
    stands = selected(bag, "--points-in", "sensor", "--ray-origin", "0,0,0")
    assert all(np.array_equal(scan.world_from_sensor, np.eye(4)) for scan in stands.scans())


def test_clouds_in_a_frame_of_the_map_that_nothing_names_can_be_taken_as_such(
    tmp_path: Path,
) -> None:
    bag = write_bag(tmp_path / "bag", "mcap", recorded("camera_init", name="world"))
    (remark,) = open_recording(bag, ReadingOptions()).remarks
    assert "if its points are in the map already, use --points-in world" in remark
    assert_right(selected(bag, "--points-in", "world", "--ray-origin", "0.4,0,1.7"))
    with pytest.raises(ToolError, match="give one of the recordings in it, .*bag$"):
        open_recording(tmp_path, ReadingOptions())


def test_folders_of_clouds_are_checked_as_well(tmp_path: Path) -> None:
    for number in range(len(STAMPS)):
        points = in_frame(seen_from(base(number)), np.eye(4))
        np.pad(points, ((0, 0), (0, 1))).tofile(tmp_path / f"{number:06d}.bin")
    rows = [" ".join(map(str, base(number)[:3].ravel())) for number in range(len(STAMPS))]
    (tmp_path / "poses.txt").write_text("\n".join(rows))
    with pytest.raises(ToolError, match=r"lie behind others.*--ray-origin X,Y,Z"):
        open_recording(tmp_path, ReadingOptions())
    assert_right(selected(tmp_path, "--ray-origin", "0.4,0,1.7"))


def words_of(pose: np.ndarray, order: str = "xyzw") -> str:
    """A pose as a line ``x y z`` and a quaternion."""
    turn = dict(zip("xyzw", Rotation.from_matrix(pose[:3, :3]).as_quat(), strict=True))
    return " ".join(map(str, [*pose[:3, 3], *(turn[axis] for axis in order)]))


def in_millimetres(pose: np.ndarray) -> np.ndarray:
    return np.vstack([pose[:3] * [1, 1, 1, 1000], pose[3]])


def test_a_sensor_that_stands_still_has_to_be_said(tmp_path):
    clouds = [Recorded("/tf_static", TF, 1, ROS2.tf(0, ("map", "lidar", shifted(*UP))))]
    points = in_frame(seen_from(np.eye(4)), np.linalg.inv(shifted(*UP)))
    clouds += [Recorded("/points", CLOUD, t, ROS2.cloud(points, t, "lidar")) for t in STAMPS]
    bag = write_bag(tmp_path / "bag", "mcap", clouds)
    moving = open_recording(bag, ReadingOptions())
    assert not moving.entries
    assert "holds no poses: record /tf" in moving.remarks[-1]
    assert "that stands still, --transform, and --points-in sensor" in moving.remarks[-1]
    still = open_recording(bag, ReadingOptions(points_in="sensor"))
    (scan,) = still.read([3])
    assert len(still.entries) == len(STAMPS)
    np.testing.assert_allclose(scan.world_from_sensor, shifted(*UP), atol=1e-12)


@pytest.mark.parametrize(
    ("said", "units", "told"),
    [
        (words_of, 1.0, ""),
        (lambda pose: words_of(np.linalg.inv(pose)), 1.0, "the poses seem to be sensor_from_world"),
        (lambda pose: words_of(pose, "wxyz"), 1.0, "seem to have quaternions w x y z.*ion wxyz"),
        (
            lambda pose: words_of(in_millimetres(pose)),
            1.0,
            r"sensor moves 2.* of the poses in metres",
        ),
        (words_of, 1000.0, "half of the points are farther .* write them in metres"),
    ],
)
def test_what_else_than_metres_from_the_sensor_to_the_world_a_folder_may_hold_is_told(
    said: Callable[[np.ndarray], str], units: float, told: str, tmp_path: Path
) -> None:
    lines = ["# x y z qx qy qz qw"]
    for number in range(len(STAMPS)):
        pose = base(number + 1)  # turned from the start
        points = units * (seen_from(pose) - UP)
        np.pad(points, ((0, 0), (0, 1))).astype(np.float32).tofile(tmp_path / f"{number:06d}.bin")
        pose[:3, 3] += pose[:3, :3] @ UP
        lines.append(said(pose))
    (tmp_path / "poses.txt").write_text("\n".join(lines))
    if told:
        with pytest.raises(ToolError, match=told):
            open_recording(tmp_path, ReadingOptions())
    else:
        assert len(open_recording(tmp_path, ReadingOptions()).entries) == len(STAMPS)


def test_poses_in_millimetres_of_a_bag_are_told(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", "mcap", recorded("lidar", in_millimetres))
    recording = open_recording(bag, ReadingOptions())
    assert not recording.entries
    (remark,) = recording.remarks
    assert "/points: 9 of 9 are left out: from scan to scan the sensor moves 3" in remark
    assert "write the positions of the poses in metres" in remark
    assert len(selected(bag, "--ray-origin", "0,0,0")) == len(STAMPS)


def test_few_points_lie_behind_others_from_the_sensor_alone() -> None:
    points = seen_from(base(3))
    assert hidden_share(points - UP) == 0
    assert hidden_share(points) > 0.07
    assert hidden_share(in_frame(points, base(3))) > 0.07
    assert hidden_share(np.zeros((5, 3))) == hidden_share(np.zeros((0, 3))) == 0


def test_points_that_many_are_equal_to_are_no_measurements() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3)).astype(np.float32)
    points[:40, 0] = 1.5  # a wall
    points[100:300:3] = UP
    points[400] = np.nan
    kept = without_repeated(points)
    np.testing.assert_array_equal(kept, np.delete(points, np.arange(100, 300, 3), axis=0))
    np.testing.assert_array_equal(without_repeated(points[:9]), points[:9])
