"""Bags of ROS 1 and ROS 2: what they hold, and what is wrong with some."""

from argparse import ArgumentTypeError
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from support.recordings.bags import KINDS, BagKind, Recorded, drive, messages_for, write_bag
from support.ros_messages import (
    CAMERA_INFO,
    CLOUD,
    IMAGE,
    ODOMETRY,
    PATH,
    POSE,
    POSE_WITH_COVARIANCE,
    TF,
    TRANSFORM,
)
from triquad_tools.console.command import ToolError
from triquad_tools.recordings.arguments import transform
from triquad_tools.recordings.opening import Recording, open_recording
from triquad_tools.recordings.recording import ReadingOptions

COUNT = 6
STAMPS = [1_700_000_000 * 10**9 + i * 10**8 for i in range(COUNT)]
SECOND = 10**9
RNG = np.random.default_rng(5)
SCANS = [RNG.normal(size=(30 + i, 3)).astype(np.float32) for i in range(COUNT)]
LIDAR = np.eye(4)
LIDAR[:3, 3] = 0.3, 0, 1.5


def poses(count: int = COUNT) -> np.ndarray:
    found = np.tile(np.eye(4), (count, 1, 1))
    for index in range(count):
        angle = 0.1 * index
        found[index, :2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        found[index, :3, 3] = index, 0.5 * index, 1.5
    return found


ROS2 = messages_for("mcap")


def a_drive(**options) -> list[Recorded]:
    return drive(ROS2, SCANS, poses(), STAMPS, LIDAR, **options)


def opened(tmp_path: Path, messages: Sequence[Recorded], **options) -> Recording:
    return open_recording(write_bag(tmp_path / "bag", "mcap", messages), ReadingOptions(**options))


def only_remark(recording: Recording) -> str:
    assert len(recording.remarks) == 1
    return recording.remarks[0]


def without(messages: list[Recorded], *topics: str) -> list[Recorded]:
    return [message for message in messages if message.topic not in topics]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("pose_kind", ["tf", "odometry"])
def test_scans_and_poses_come_out_of_every_kind_of_bag(
    tmp_path: Path, kind: BagKind, pose_kind: str
) -> None:
    messages = drive(messages_for(kind), SCANS, poses(), STAMPS, LIDAR, pose_kind)
    recording = open_recording(write_bag(tmp_path / "bag", kind, messages), ReadingOptions())
    assert [entry.stamp_ns for entry in recording.entries] == STAMPS
    assert {entry.source for entry in recording.entries} == {"lidar.points"}
    assert recording.remarks == []
    for scan, points, pose in zip(recording.read(range(COUNT)), SCANS, poses(), strict=True):
        assert np.array_equal(scan.points, points)
        assert np.allclose(scan.world_from_sensor, pose, atol=1e-12)
    third, fifth = recording.read([2, 4])
    assert np.array_equal(third.points, SCANS[2])
    assert np.array_equal(fifth.points, SCANS[4])


def test_a_bare_file_and_a_folder_of_parts_are_bags_too(tmp_path: Path) -> None:
    folder = write_bag(tmp_path / "bag", "mcap", a_drive())
    (file,) = folder.glob("*.mcap")
    assert len(open_recording(file, ReadingOptions()).entries) == COUNT
    ros = messages_for("ros1")
    messages = drive(ros, SCANS, poses(), STAMPS, LIDAR)
    parts = tmp_path / "parts"
    parts.mkdir()
    write_bag(parts / "b", "ros1", messages[:6])
    write_bag(parts / "a", "ros1", messages[6:])
    recording = open_recording(parts, ReadingOptions())
    assert [entry.stamp_ns for entry in recording.entries] == STAMPS
    assert all(map(np.array_equal, (scan.points for scan in recording.read(range(COUNT))), SCANS))


@pytest.mark.parametrize("kind", ["mcap", "ros1"])
def test_bags_of_one_folder_that_are_no_parts_of_one_recording_are_refused(
    tmp_path: Path, kind: BagKind
) -> None:
    ros = messages_for(kind)
    elsewhere = poses() + [[0, 0, 0, 30], [0] * 4, [0] * 4, [0] * 4]

    def both(name: str, places: np.ndarray, after_s: float) -> Path:
        stamps = [stamp + round(after_s * SECOND) for stamp in STAMPS]
        for part, (where, when) in enumerate(((poses(), STAMPS), (places, stamps))):
            bag = write_bag(tmp_path / f"{name}{part}", kind, drive(ros, SCANS, where, when, LIDAR))
            file = bag if bag.is_file() else next(bag.glob("*.mcap"))
            target = tmp_path / name / f"{part}{file.suffix}"
            target.parent.mkdir(exist_ok=True)
            file.rename(target)
        return tmp_path / name

    with pytest.raises(ToolError, match=r"0\.\w+ and 1\.\w+ overlap by 0.2 s on /lidar/points"):
        open_recording(both("overlap", poses(), 0.3), ReadingOptions())
    jump = both("jump", elsewhere, 3600)
    with pytest.raises(ToolError, match=r"is 25\.\d m elsewhere: .* use --map-frame odom"):
        open_recording(jump, ReadingOptions())
    assert len(open_recording(jump, ReadingOptions(map_frame="odom")).entries) == 2 * COUNT


def test_streams_tell_what_is_made_of_each_topic(tmp_path: Path) -> None:
    messages = a_drive()
    messages.append(
        Recorded("/odom", ODOMETRY, STAMPS[0], ROS2.odometry(STAMPS[0], LIDAR, "odom", "base_link"))
    )
    messages.append(Recorded("/other", POSE, STAMPS[0], ROS2.pose(STAMPS[0], LIDAR, "map")))
    streams = {stream.name: stream for stream in opened(tmp_path, messages).streams}
    assert (streams["/lidar/points"].kind, streams["/lidar/points"].count) == (CLOUD, COUNT)
    assert streams["/lidar/points"].frame == "lidar"
    assert streams["/lidar/points"].use == (
        f"{COUNT} scans, source lidar.points, no point times: motion is not taken out, 10.0 Hz"
    )
    assert streams["/tf"].use == "the poses, 10.0 Hz"
    assert streams["/odom"].use == "other poses: --poses /odom"
    assert streams["/odom"].frame == "odom > base_link"


def test_poses_without_a_name_are_those_of_what_the_sensor_is_fixed_to(tmp_path: Path) -> None:
    messages = without(a_drive(), "/tf")
    for pose, stamp in zip(poses(), STAMPS, strict=True):
        body = pose @ np.linalg.inv(LIDAR)
        messages.append(Recorded("/pose", POSE, stamp, ROS2.pose(stamp, body, "map")))
    recording = opened(tmp_path, messages)
    assert "/pose: taken as poses of base_link, since its messages" in only_remark(recording)
    for scan, pose in zip(recording.read(range(COUNT)), poses(), strict=True):
        assert np.allclose(scan.world_from_sensor, pose)
    of_lidar = open_recording(tmp_path / "bag", ReadingOptions(body_frame="lidar"))
    for scan, pose in zip(of_lidar.read(range(COUNT)), poses(), strict=True):
        assert np.allclose(scan.world_from_sensor, pose @ np.linalg.inv(LIDAR))


@pytest.mark.parametrize("kind", [TRANSFORM, POSE_WITH_COVARIANCE, PATH])
def test_poses_come_in_many_types(tmp_path: Path, kind: str) -> None:
    messages = without(a_drive(), "/tf")
    for index, (pose, stamp) in enumerate(zip(poses(), STAMPS, strict=True)):
        body = pose @ np.linalg.inv(LIDAR)
        message = {
            TRANSFORM: lambda s, b: ROS2.tf(s, ("map", "base_link", b)).transforms[0],
            POSE_WITH_COVARIANCE: lambda s, b: ROS2.pose_with_covariance(s, b, "map"),
            PATH: lambda _, b, n=index: ROS2.path(
                STAMPS[: n + 1], [*poses()[:n] @ np.linalg.inv(LIDAR), b], "map"
            ),
        }[kind](stamp, body)
        messages.append(Recorded("/where", kind, stamp, message))
    recording = opened(tmp_path, messages)
    for scan, pose in zip(recording.read(range(COUNT)), poses(), strict=True):
        assert np.allclose(scan.world_from_sensor, pose)
    unstamped = ROS2.path([0] * COUNT, poses(), "map")
    messages = [*without(messages, "/where"), Recorded("/where", PATH, STAMPS[-1], unstamped)]
    remarks = opened(tmp_path / "unstamped", messages).remarks
    assert "/where: 1 poses are left out: they have no times of their own" in remarks


def test_depth_images_are_mapped_in_the_optical_frame(tmp_path: Path) -> None:
    matrix = np.array([[100.0, 0, 4], [0, 100, 3], [0, 0, 1]])
    image = np.full((6, 8), 2000, np.uint16)
    messages = []
    for pose, stamp in zip(poses(), STAMPS, strict=True):
        message = ROS2.image(image, "16UC1", stamp)
        messages.append(Recorded("/camera/depth/image_rect", IMAGE, stamp, message))
        messages.append(Recorded("/tf", TF, stamp, ROS2.tf(stamp, ("map", "optical", pose))))
    assert "nothing is known of the camera of /camera/depth/camera_info" in only_remark(
        opened(tmp_path / "without", messages)
    )
    info = ROS2.camera_info((6, 8), matrix, STAMPS[0])
    messages.append(Recorded("/camera/depth/camera_info", CAMERA_INFO, STAMPS[-1], info))
    messages.append(Recorded("/camera/color/image", IMAGE, STAMPS[0], ROS2.image(image, "rgb8", 0)))
    recording = opened(tmp_path, messages)
    assert len(recording.entries) == COUNT
    (scan,) = recording.read([3])
    assert np.allclose(scan.points[0], [-0.08, -0.06, 2])
    assert np.allclose(scan.world_from_sensor, poses()[3])


def test_several_sensors_are_mapped_together_or_chosen(tmp_path: Path) -> None:
    messages = a_drive()
    rear = LIDAR.copy()
    rear[0, 3] = -2
    for points, stamp in zip(SCANS, STAMPS, strict=True):
        cloud = ROS2.cloud(points, stamp, "rear_lidar")
        messages.append(Recorded("/rear/points", CLOUD, stamp + 3, cloud))
    static = ROS2.tf(0, ("base_link", "rear_lidar", rear))
    messages.append(Recorded("/tf_static", TF, STAMPS[0], static))
    recording = opened(tmp_path, sorted(messages, key=lambda each: each.recorded_ns))
    assert [entry.source for entry in recording.entries] == ["lidar.points", "rear.points"] * COUNT
    _, scan = recording.read([0, 1])
    assert np.allclose(scan.world_from_sensor, poses()[0] @ np.linalg.inv(LIDAR) @ rear)
    chosen = open_recording(tmp_path / "bag", ReadingOptions(topics=("/rear/points",)))
    assert {entry.source for entry in chosen.entries} == {"rear.points"}


def test_a_cloud_is_placed_as_each_of_its_points_was_measured(tmp_path: Path) -> None:
    offsets = np.linspace(0, 0.1, 200)
    world = RNG.normal(size=(200, 3)) * 5
    speed_m_s = 10.0
    points = world - [[speed_m_s * offset, 0, 0] for offset in offsets]
    cloud = ROS2.cloud(points, STAMPS[0], more={"time": offsets.astype(np.float32)})
    messages = [Recorded("/points", CLOUD, STAMPS[0], cloud)]
    for stamp in STAMPS:
        pose = np.eye(4)
        pose[0, 3] = speed_m_s * (stamp - STAMPS[0]) / 1e9
        messages.append(Recorded("/tf", TF, stamp, ROS2.tf(stamp, ("odom", "lidar", pose))))
    (scan,) = opened(tmp_path, messages).read([0])
    placed = scan.points @ scan.world_from_sensor[:3, :3].T + scan.world_from_sensor[:3, 3]
    assert np.abs(placed - world).max() < 2e-3


def test_a_cloud_of_the_whole_map_is_no_scan(tmp_path: Path) -> None:
    messages = a_drive()
    whole = ROS2.cloud(SCANS[0], STAMPS[0], "map")
    messages.append(Recorded("/map_cloud", CLOUD, STAMPS[0], whole))
    recording = opened(tmp_path, messages)
    assert {entry.source for entry in recording.entries} == {"lidar.points"}
    streams = {stream.name: stream for stream in recording.streams}
    assert streams["/map_cloud"].use == "other scans: --topics /map_cloud"


def test_two_that_publish_one_transform_are_named_and_one_can_be_chosen(tmp_path: Path) -> None:
    """Of another parent, or of the same one and told apart by the topic alone."""
    for parent, choice in (("map", {"map_frame": "odom"}), ("odom", {"poses": "/tf"})):
        messages = a_drive()
        for pose, stamp in zip(poses(), STAMPS, strict=True):
            pose[1, 3] += 0.4
            other = ROS2.tf(stamp + 9, (parent, "base_link", pose @ np.linalg.inv(LIDAR)))
            messages.append(Recorded("/other/tf", TF, stamp + 9, other))
        both = opened(tmp_path / parent, messages)
        assert not both.entries
        assert "choose" in only_remark(both)
        assert "6 times" in only_remark(both) or "jumps to and fro, 9 times" in only_remark(both)
        chosen = open_recording(tmp_path / parent / "bag", ReadingOptions(**choice))
        for scan, pose in zip(chosen.read(range(COUNT)), poses(), strict=True):
            assert np.allclose(scan.world_from_sensor, pose)


def test_missing_poses_and_transforms_are_named_with_the_remedy(tmp_path: Path) -> None:
    nothing = opened(tmp_path / "a", without(a_drive(), "/tf"))
    assert not nothing.entries
    assert "it holds no poses: record /tf" in only_remark(nothing)
    unmounted = opened(tmp_path / "c", without(a_drive(), "/tf_static"))
    assert not unmounted.entries
    assert "no transform names the frame 'lidar' (known: base_link, odom)" in (
        only_remark(unmounted)
    )
    loose = opened(tmp_path / "b", without(a_drive(pose_kind="odometry"), "/tf_static"))
    assert not loose.entries
    assert "no transform names the frame 'lidar' (known: base_link, odom)" in only_remark(loose)
    assert "with --transform 'base_link lidar X Y Z QX QY QZ QW'" in only_remark(loose)
    assert "with --transform 'base_link lidar X Y Z QX QY QZ QW'" in only_remark(unmounted)
    with pytest.raises(
        ToolError, match=r"--body-frame roof: nothing names it; known are base_link, lidar"
    ):
        open_recording(tmp_path / "b" / "bag", ReadingOptions(body_frame="roof"))


def test_a_transform_may_be_given(tmp_path: Path) -> None:
    mounted = transform("base_link lidar 0.3 0 1.5 0 0 0 1")
    recording = opened(tmp_path, without(a_drive(), "/tf_static"), transforms=(mounted,))
    assert np.allclose(next(recording.read([2])).world_from_sensor, poses()[2])
    for text in ("base_link lidar 0 0 0", "base_link lidar 0 0 0 0 0 0 0", "a b 0 0 0 0 0 0 x"):
        with pytest.raises(ArgumentTypeError, match="PARENT CHILD X Y Z"):
            transform(text)


def test_clouds_outside_of_the_poses_are_left_out_and_counted(tmp_path: Path) -> None:
    messages = [m for m in a_drive() if m.topic != "/tf" or m.recorded_ns < STAMPS[4]]
    recording = opened(tmp_path, messages)
    assert [entry.stamp_ns for entry in recording.entries] == STAMPS[:4]
    assert "/lidar/points: 2 of 6 are left out: odom from base_link: 0.1 s after the last" in (
        only_remark(recording)
    )


def test_clocks_that_differ_are_recognised(tmp_path: Path) -> None:
    messages = without(a_drive(), "/lidar/points")
    for points, stamp in zip(SCANS, STAMPS, strict=True):
        cloud = ROS2.cloud(
            points, stamp - STAMPS[0] + 5 * SECOND
        )  # since the lidar was switched on
        messages.append(Recorded("/lidar/points", CLOUD, stamp + 2, cloud))
    recording = opened(tmp_path, messages)
    assert not recording.entries
    assert "--recorder-clock" in only_remark(recording)
    by_recorder = open_recording(tmp_path / "bag", ReadingOptions(recorder_clock=True))
    assert len(by_recorder.entries) == COUNT


def test_topics_that_cannot_be_mapped_are_refused_with_those_that_can(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", "mcap", a_drive())
    for topic, words in (("/nothing", "does not exist"), ("/tf", "is tf2_msgs/msg/TFMessage")):
        with pytest.raises(ToolError, match=words) as caught:
            open_recording(path, ReadingOptions(topics=(topic,)))
        assert "to map there is /lidar/points" in str(caught.value)
    with pytest.raises(ToolError, match="--poses /nothing: there are no such poses, only tf"):
        open_recording(path, ReadingOptions(poses="/nothing"))


def test_clouds_that_are_none_are_left_out_and_counted(tmp_path: Path) -> None:
    messages = a_drive()
    clouds = [message.message for message in messages if message.topic == "/lidar/points"]
    clouds[1].fields[0].name = "range"
    clouds[2].fields[0].datatype = 5
    recording = opened(tmp_path, messages)
    assert len(recording.entries) == COUNT - 2
    assert any(
        "1 of 6 are left out: the cloud has no field x" in line for line in recording.remarks
    )
    assert any("int32" in line for line in recording.remarks)
    kept = [scan.points for scan in recording.read(range(COUNT - 2))]
    assert all(map(np.array_equal, kept, [SCANS[0], *SCANS[3:]]))


def test_poses_that_are_none_are_left_out_and_counted(tmp_path: Path) -> None:
    messages = a_drive()
    moving = [message.message for message in messages if message.topic == "/tf"]
    moving[2].transforms[0].transform.rotation.w = np.nan
    recording = opened(tmp_path, messages)
    assert len(recording.entries) == COUNT  # between those around
    assert "/tf: 1 poses are left out: quaternion_xyzw" in only_remark(recording)


@pytest.mark.parametrize("kind", ["sqlite3", "ros1"])
def test_a_damaged_bag_is_refused_with_the_remedy(tmp_path: Path, kind: BagKind) -> None:
    messages = drive(messages_for(kind), SCANS, poses(), STAMPS, LIDAR)
    path = write_bag(tmp_path / "bag", kind, messages)
    file = path if path.is_file() else next(f for f in path.iterdir() if f.suffix != ".yaml")
    file.write_bytes(file.read_bytes()[:-2000])
    with pytest.raises(ToolError, match="saves what is left") as caught:
        list(open_recording(path, ReadingOptions()).read(range(COUNT)))
    assert "\n" not in str(caught.value)
