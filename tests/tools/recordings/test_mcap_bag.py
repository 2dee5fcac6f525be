"""MCAP files of other writers: of ROS 1, without an index, cut off, with foreign channels."""

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, IndexType, Writer
from support.files.file_damage import flipped
from support.recordings.bags import Recorded, drive, messages_for
from triquad_tools.console.command import ToolError
from triquad_tools.recordings.opening import open_recording
from triquad_tools.recordings.recording import ReadingOptions

COUNT = 20
STAMPS = [1_700_000_000 * 10**9 + i * 10**8 for i in range(COUNT)]
SCANS = [np.random.default_rng(i).normal(size=(40, 3)).astype(np.float32) for i in range(COUNT)]
POSES = np.tile(np.eye(4), (COUNT, 1, 1))
POSES[:, 0, 3] = range(COUNT)
BARE = {"index_types": IndexType.NONE, "repeat_channels": False, "use_statistics": False}


def written(path: Path, is_ros_1: bool = False, **options: object) -> Path:
    """A drive, with a channel of JSON and one of packets before it."""
    ros = messages_for("ros1" if is_ros_1 else "mcap")
    messages: Iterable[Recorded] = drive(ros, SCANS, POSES, STAMPS, np.eye(4))
    options = {"chunk_size": 4000, "compression": CompressionType.ZSTD, **options}
    with path.open("wb") as file:
        writer = Writer(file, **options)  # type: ignore[arg-type]
        writer.start(profile="", library="")
        schema = writer.register_schema("foxglove.Log", "jsonschema", b"{}")
        log = writer.register_channel("/log", "json", schema)
        writer.add_message(log, STAMPS[0], b"{}", STAMPS[0])
        schema = writer.register_schema("velodyne_msgs/VelodyneScan", "ros1msg", b"")
        packets = writer.register_channel("/packets", "ros1" if is_ros_1 else "cdr", schema)
        writer.add_message(packets, STAMPS[0], b"packets", STAMPS[0])
        channels: dict[str, int] = {}
        for topic, kind, stamp, message in messages:
            if topic not in channels:
                text, _ = ros.types.generate_msgdef(kind, ros_version=1 if is_ros_1 else 2)
                name = kind.replace("/msg/", "/") if is_ros_1 else kind
                encodings = ("ros1msg", "ros1") if is_ros_1 else ("ros2msg", "cdr")
                schema = writer.register_schema(name, encodings[0], text.encode())
                channels[topic] = writer.register_channel(topic, encodings[1], schema)
            writer.add_message(channels[topic], stamp, ros.encode(message, kind), stamp)
        writer.finish()
    return path


def compressed(path: Path) -> Path:
    data = zstandard.compress(path.read_bytes())
    path = path.with_name(path.name + ".zstd")
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("is_ros_1", [False, True])
@pytest.mark.parametrize("options", [{}, BARE, {"use_chunking": False, **BARE}])
@pytest.mark.parametrize("packed", [lambda path: path, compressed])
def test_a_drive_is_read_from_whatever_a_writer_makes_of_it(
    tmp_path: Path, is_ros_1: bool, options: dict[str, object], packed: Callable[[Path], Path]
) -> None:
    path = packed(written(tmp_path / "drive.mcap", is_ros_1, **options))
    recording = open_recording(path, ReadingOptions())
    assert [entry.stamp_ns for entry in recording.entries] == STAMPS
    (remark,) = recording.remarks
    assert remark.endswith("not encoded as messages of ROS: /log (json)")
    streams = {stream.name: stream for stream in recording.streams}
    assert streams["/lidar/points"].count == COUNT
    assert streams["/packets"].use.startswith("packets: play it to velodyne_pointcloud")
    assert streams["/log"].use == "not read: json, not a message of ROS"
    for scan, points, pose in zip(recording.read(range(COUNT)), SCANS, POSES, strict=True):
        assert np.array_equal(scan.points, points)
        assert np.allclose(scan.world_from_sensor, pose)


def test_what_was_cut_off_is_read_up_to_there_and_told(tmp_path: Path) -> None:
    path = written(tmp_path / "drive.mcap")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    recording = open_recording(path, ReadingOptions())
    count = len(recording.entries)
    assert COUNT // 3 < count < COUNT
    assert any(
        "drive.mcap (of 0.0" in line and "cut off or damaged after" in line
        for line in recording.remarks
    )
    assert all(map(np.array_equal, (s.points for s in recording.read(range(count))), SCANS))
    path.write_bytes(whole[:20])
    with pytest.raises(ToolError, match="'mcap recover' saves what is left"):
        open_recording(path, ReadingOptions())


def test_damaged_chunks_and_messages_are_left_out_and_counted(tmp_path: Path) -> None:
    path = written(tmp_path / "drive.mcap", compression=CompressionType.NONE)
    data = path.read_bytes()
    path.write_bytes(flipped(data, data.index(SCANS[9].tobytes()) + 5))  # its checksum is wrong

    recording = open_recording(path, ReadingOptions())
    assert COUNT // 2 < len(recording.entries) < COUNT
    assert any("1 of its chunks are damaged; what is whole" in line for line in recording.remarks)
    assert any("messages that its index names" in line for line in recording.remarks)


def test_a_message_that_cannot_be_decoded_does_not_end_a_bag(tmp_path: Path) -> None:
    path = written(tmp_path / "drive.mcap", compression=CompressionType.NONE, enable_crcs=False)
    data = path.read_bytes()
    at = data.index(SCANS[9].tobytes()) - 4  # the length of the points
    path.write_bytes(data[:at] + b"\xff\xff\xff\x7f" + data[at + 4 :])
    recording = open_recording(path, ReadingOptions())
    assert [entry.stamp_ns for entry in recording.entries] == STAMPS[:9] + STAMPS[10:]
    assert any(
        "/lidar/points: 1 of 20 are left out: no sensor_msgs/msg/PointCloud2" in line
        for line in recording.remarks
    )
    kept = [scan.points for scan in recording.read(range(COUNT - 1))]
    assert all(map(np.array_equal, kept, SCANS[:9] + SCANS[10:]))
