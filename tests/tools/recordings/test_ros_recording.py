"""Bags of ROS 1 and ROS 2: what they hold, and what is wrong with some."""

from argparse import ArgumentTypeError
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.poses import shifted
from support.recordings import trajectories
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
LIDAR = shifted(0.3, z=1.5)
POSES = trajectories.matrices(trajectories.drive(COUNT, turn_rad=0.1, start=(0.0, 0.0, 1.5)))
BODIES = POSES @ np.linalg.inv(LIDAR)
ROS2 = messages_for("mcap")


def a_drive(**options) -> list[Recorded]:
    return drive(ROS2, SCANS, POSES, STAMPS, LIDAR, **options)


def each(topic: str, kind: str, build: Callable[[int, np.ndarray], Any]) -> list[Recorded]:
    """A message for each moment of the drive, built of its time and the pose of the body."""
    moments = zip(STAMPS, BODIES, strict=True)
    return [Recorded(topic, kind, stamp + 3, build(stamp, body)) for stamp, body in moments]


def assert_poses(recording: Recording, expected: np.ndarray = POSES) -> None:
    for scan, pose in zip(recording.read(range(COUNT)), expected, strict=True):
        assert np.allclose(scan.world_from_sensor, pose, atol=1e-12)


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
    messages = drive(messages_for(kind), SCANS, POSES, STAMPS, LIDAR, pose_kind)
    recording = open_recording(write_bag(tmp_path / "bag", kind, messages), ReadingOptions())
    assert [entry.stamp_ns for entry in recording.entries] == STAMPS
    assert {entry.source for entry in recording.entries} == {"lidar.points"}
    assert recording.remarks == []
    assert all(map(np.array_equal, (scan.points for scan in recording.read(range(COUNT))), SCANS))
    assert_poses(recording)
    some = [scan.points for scan in recording.read([2, 4])]
    assert all(map(np.array_equal, some, SCANS[2::2]))


def test_a_bare_file_and_a_folder_of_parts_are_bags_too(tmp_path: Path) -> None:
    folder = write_bag(tmp_path / "bag", "mcap", a_drive())
    (file,) = folder.glob("*.mcap")
    assert len(open_recording(file, ReadingOptions()).entries) == COUNT
    ros = messages_for("ros1")
    messages = drive(ros, SCANS, POSES, STAMPS, LIDAR)
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
    elsewhere = POSES + [[0, 0, 0, 30], [0] * 4, [0] * 4, [0] * 4]

    def both(name: str, places: np.ndarray, after_s: float) -> Path:
        stamps = [stamp + round(after_s * SECOND) for stamp in STAMPS]
        for part, (where, when) in enumerate(((POSES, STAMPS), (places, stamps))):
            bag = write_bag(tmp_path / f"{name}{part}", kind, drive(ros, SCANS, where, when, LIDAR))
            file = bag if bag.is_file() else next(bag.glob("*.mcap"))
            target = tmp_path / name / f"{part}{file.suffix}"
            target.parent.mkdir(exist_ok=True)
            file.rename(target)
        return tmp_path / name

    with pytest.raises(ToolError, match=r"0\.\w+ and 1\.\w+ overlap by 0.2 s on /lidar/points"):
        open_recording(both("overlap", POSES, 0.3), ReadingOptions())
    jump = both("jump", elsewhere, 3600)
    with pytest.raises(ToolError, match=r"is 25\.\d m elsewhere: .* use --map-frame odom"):
        open_recording(jump, ReadingOptions())
    assert len(open_recording(jump, ReadingOptions(map_frame="odom")).entries) == 2 * COUNT


def test_streams_tell_what_is_made_of_each_topic(tmp_path: Path) -> None:
    messages = a_drive()
    odometry = ROS2.odometry(STAMPS[0], LIDAR, "odom", "base_link")
    messages.append(Recorded("/odom", ODOMETRY, STAMPS[0], odometry))
    messages.append(Recorded("/other", POSE, STAMPS[0], ROS2.pose(STAMPS[0], LIDAR, "map")))
    whole = ROS2.cloud(SCANS[0], STAMPS[0], "map")
    messages.append(Recorded("/map_cloud", CLOUD, STAMPS[0], whole))
    recording = opened(tmp_path, messages)
    assert {entry.source for entry in recording.entries} == {"lidar.points"}
    streams = {stream.name: stream for stream in recording.streams}
    assert streams["/map_cloud"].use == "other scans: --topics /map_cloud"
    assert (streams["/lidar/points"].kind, streams["/lidar/points"].count) == (CLOUD, COUNT)
    assert streams["/lidar/points"].frame == "lidar"
    assert streams["/lidar/points"].use == (
        f"{COUNT} scans, source lidar.points, no point times: motion is not taken out, 10.0 Hz"
    )
    assert streams["/tf"].use == "the poses, 10.0 Hz"
    assert streams["/odom"].use == "other poses: --poses /odom"
    assert streams["/odom"].frame == "odom > base_link"


def test_poses_without_a_name_are_those_of_what_the_sensor_is_fixed_to(tmp_path: Path) -> None:
    told = each("/pose", POSE, lambda stamp, body: ROS2.pose(stamp, body, "map"))
    recording = opened(tmp_path, [*without(a_drive(), "/tf"), *told])
    assert "/pose: taken as poses of base_link, since its messages" in only_remark(recording)
    assert_poses(recording)
    assert_poses(open_recording(tmp_path / "bag", ReadingOptions(body_frame="lidar")), BODIES)


@pytest.mark.parametrize("kind", [TRANSFORM, POSE_WITH_COVARIANCE, PATH])
def test_poses_come_in_many_types(tmp_path: Path, kind: str) -> None:
    def path_up_to(stamp: int, _: np.ndarray) -> Any:
        count = STAMPS.index(stamp) + 1
        return ROS2.path(STAMPS[:count], BODIES[:count], "map")

    build = {
        TRANSFORM: lambda stamp, body: ROS2.tf(stamp, ("map", "base_link", body)).transforms[0],
        POSE_WITH_COVARIANCE: lambda stamp, body: ROS2.pose_with_covariance(stamp, body, "map"),
        PATH: path_up_to,
    }[kind]
    still = without(a_drive(), "/tf")
    assert_poses(opened(tmp_path, [*still, *each("/where", kind, build)]))
    unstamped = Recorded("/where", PATH, STAMPS[-1], ROS2.path([0] * COUNT, POSES, "map"))
    remarks = opened(tmp_path / "unstamped", [*still, unstamped]).remarks
    assert "/where: 1 poses are left out: they have no times of their own" in remarks


def test_depth_images_are_mapped_in_the_optical_frame(tmp_path: Path) -> None:
    matrix = np.array([[100.0, 0, 4], [0, 100, 3], [0, 0, 1]])
    image = np.full((6, 8), 2000, np.uint16)
    depth = "/camera/depth/image_rect"
    messages = each(depth, IMAGE, lambda stamp, _: ROS2.image(image, "16UC1", stamp))
    messages += each("/tf", TF, lambda stamp, body: ROS2.tf(stamp, ("map", "optical", body)))
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
    assert np.allclose(scan.world_from_sensor, BODIES[3])


def test_several_sensors_are_mapped_together_or_chosen(tmp_path: Path) -> None:
    messages, rear = a_drive(), shifted(-2, z=1.5)
    messages += each("/rear/points", CLOUD, lambda at, _: ROS2.cloud(SCANS[0], at, "rear_lidar"))
    static = ROS2.tf(0, ("base_link", "rear_lidar", rear))
    messages.append(Recorded("/tf_static", TF, STAMPS[0], static))
    recording = opened(tmp_path, sorted(messages, key=lambda each: each.recorded_ns))
    assert [entry.source for entry in recording.entries] == ["lidar.points", "rear.points"] * COUNT
    _, scan = recording.read([0, 1])
    assert np.allclose(scan.world_from_sensor, BODIES[0] @ rear)
    chosen = open_recording(tmp_path / "bag", ReadingOptions(topics=("/rear/points",)))
    assert {entry.source for entry in chosen.entries} == {"rear.points"}


def test_a_cloud_is_placed_as_each_of_its_points_was_measured(tmp_path: Path) -> None:
    offsets = np.linspace(0, 0.1, 200)
    world = RNG.normal(size=(200, 3)) * 5
    speed_m_s = 10.0
    points = world - [[speed_m_s * offset, 0, 0] for offset in offsets]
    cloud = ROS2.cloud(points, STAMPS[0], more={"time": offsets.astype(np.float32)})

    def moving(stamp: int, _: np.ndarray) -> Any:
        at = shifted(speed_m_s * (stamp - STAMPS[0]) / 1e9)
        return ROS2.tf(stamp, ("odom", "lidar", at))

    messages = [Recorded("/points", CLOUD, STAMPS[0], cloud), *each("/tf", TF, moving)]
    (scan,) = opened(tmp_path, messages).read([0])
    placed = scan.points @ scan.world_from_sensor[:3, :3].T + scan.world_from_sensor[:3, 3]
    assert np.abs(placed - world).max() < 2e-3


def test_two_that_publish_one_transform_are_named_and_one_can_be_chosen(tmp_path: Path) -> None:
    """Of another parent, or of the same one and told apart by the topic alone."""
    for parent, choice in (("map", {"map_frame": "odom"}), ("odom", {"poses": "/tf"})):

        def other(stamp: int, body: np.ndarray, parent: str = parent) -> Any:
            return ROS2.tf(stamp + 9, (parent, "base_link", shifted(y=0.4) @ body))

        both = opened(tmp_path / parent, [*a_drive(), *each("/other/tf", TF, other)])
        assert not both.entries
        assert "choose" in only_remark(both)
        assert "6 times" in only_remark(both) or "jumps to and fro, 9 times" in only_remark(both)
        assert_poses(open_recording(tmp_path / parent / "bag", ReadingOptions(**choice)))


def test_missing_poses_and_transforms_are_named_with_the_remedy(tmp_path: Path) -> None:
    nothing = opened(tmp_path / "a", without(a_drive(), "/tf"))
    assert not nothing.entries
    assert "it holds no poses: record /tf" in only_remark(nothing)
    for kind in ("tf", "odometry"):
        unmounted = opened(tmp_path / kind, without(a_drive(pose_kind=kind), "/tf_static"))
        assert not unmounted.entries
        told = only_remark(unmounted)
        assert "no transform names the frame 'lidar' (known: base_link, odom)" in told
        assert "with --transform 'base_link lidar X Y Z QX QY QZ QW'" in told
    with pytest.raises(ToolError, match="--body-frame roof: .* known are base_link, lidar"):
        open_recording(tmp_path / "odometry" / "bag", ReadingOptions(body_frame="roof"))


def test_a_transform_may_be_given(tmp_path: Path) -> None:
    mounted = transform("base_link lidar 0.3 0 1.5 0 0 0 1")
    recording = opened(tmp_path, without(a_drive(), "/tf_static"), transforms=(mounted,))
    assert np.allclose(next(recording.read([2])).world_from_sensor, POSES[2])
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
        since_switched_on = stamp - STAMPS[0] + 5 * SECOND
        cloud = ROS2.cloud(points, since_switched_on)
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


def test_poses_that_are_none_are_left_out_and_counted(tmp_path: Path) -> None:
    messages = a_drive()
    moving = [message.message for message in messages if message.topic == "/tf"]
    moving[2].transforms[0].transform.rotation.w = np.nan
    recording = opened(tmp_path, messages)
    assert len(recording.entries) == COUNT  # between those around
    assert "/tf: 1 poses are left out: quaternion_xyzw" in only_remark(recording)
