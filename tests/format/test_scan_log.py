"""The scan log: what ROS 2 writes, whole or refused, and its files by their names."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from triquad_format.errors import DamagedMapFileError
from triquad_format.records.pose import pose_matrices, quaternion_of
from triquad_format.scan_log.log_folder import Segment, history, segment_name, segments
from triquad_format.scan_log.ros_messages import (
    CLOUD_TYPE,
    DEFINITIONS,
    TRANSFORMS_TYPE,
    pack_cloud,
    pack_transform,
)
from triquad_format.scan_log.segment import (
    GRAIN_M,
    LoggedReset,
    LoggedScan,
    SegmentWriter,
    read_segment,
)

ROS: Any = get_typestore(Stores.ROS2_HUMBLE)
STAMPS = st.integers(0, 2**31 * 10**9 - 1)
FRAMES = st.text(min_size=1, max_size=9)
QUATERNIONS = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)
POSITION = np.array([448_262.123456, 5_411_932.987654, -3.25])


def unit(quaternion: tuple[float, ...]) -> np.ndarray:
    return np.array(quaternion) / np.linalg.norm(quaternion)


def pose(quaternion: tuple[float, ...] = (0.1, -0.2, 0.3, 0.9)) -> np.ndarray:
    return pose_matrices(POSITION, unit(quaternion))


def scan(number: int = 0, source: str = "roof", points: int = 50, misses: int = 0) -> LoggedScan:
    rng = np.random.default_rng(number)
    return LoggedScan(
        source,
        10**18 + number,
        pose((0.1 * number, 0.2, 0.3, 1.0)),
        rng.uniform(-90, 90, (points, 3)).astype(np.float32),
        rng.normal(size=(misses, 3)).astype(np.float32),
    )


def written(path: Path, *scans: LoggedScan) -> Path:
    writer = SegmentWriter(path)
    for each in scans:
        writer.add(each)
    writer.finish()
    return path


@given(QUATERNIONS)
def test_a_quaternion_of_a_rotation_gives_the_rotation_again(quaternion) -> None:
    rotation = pose(quaternion)[:3, :3]
    again = pose_matrices(np.zeros(3), quaternion_of(rotation))[:3, :3]
    np.testing.assert_allclose(again, rotation, atol=1e-12)


@given(STAMPS, FRAMES, st.integers(0, 5))
def test_a_cloud_is_what_ros_writes(stamp_ns, frame, count) -> None:
    points = np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32)
    packed = pack_cloud(stamp_ns, frame, points)
    message = ROS.deserialize_cdr(packed, CLOUD_TYPE)
    assert bytes(ROS.serialize_cdr(message, CLOUD_TYPE)) == packed
    stamp = message.header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == stamp_ns
    assert message.header.frame_id == frame
    assert [field.name for field in message.fields] == ["x", "y", "z"]
    assert message.data.tobytes() == points.tobytes()


@given(STAMPS, FRAMES, QUATERNIONS)
def test_a_transform_is_what_ros_writes(stamp_ns, child, quaternion) -> None:
    packed = pack_transform(stamp_ns, "map", child, pose(quaternion))
    message = ROS.deserialize_cdr(packed, TRANSFORMS_TYPE)
    assert bytes(ROS.serialize_cdr(message, TRANSFORMS_TYPE)) == packed
    (transform,) = message.transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", child)
    assert transform.transform.translation.y == POSITION[1]
    turn = transform.transform.rotation
    again = pose_matrices(POSITION, np.array([turn.x, turn.y, turn.z, turn.w]))
    np.testing.assert_allclose(again, pose(quaternion), atol=1e-12)


@pytest.mark.parametrize("kind", [CLOUD_TYPE, TRANSFORMS_TYPE])
def test_the_definitions_are_those_of_ros(kind) -> None:
    own = get_typestore(Stores.EMPTY)
    own.register(get_types_from_msg(DEFINITIONS[kind], kind))
    assert own.hash_rihs01(kind) == ROS.hash_rihs01(kind)


def test_scans_come_back_in_order_within_a_grain(tmp_path) -> None:
    scans = [scan(0), scan(1, "front/left", misses=3), scan(1, "roof"), scan(2, points=0)]
    found = list(read_segment(written(tmp_path / "a.mcap", *scans)))
    for before, after in zip(scans, found, strict=True):
        assert (after.source, after.stamp_ns) == (before.source, before.stamp_ns)
        np.testing.assert_allclose(after.world_from_sensor, before.world_from_sensor, atol=1e-12)
        np.testing.assert_allclose(after.points, before.points, atol=GRAIN_M / 2)
        np.testing.assert_array_equal(after.no_return, before.no_return)


def test_resets_come_back(tmp_path) -> None:
    path = tmp_path / "a.mcap"
    writer = SegmentWriter(path)
    boxes = [(np.full(3, -np.inf), POSITION), (POSITION - 1, POSITION + 1)]
    for minimum, maximum in boxes:
        writer.add(scan())
        writer.add_reset(LoggedReset(minimum, maximum), 5)
    writer.finish()
    found = list(read_segment(path))
    assert [type(each) for each in found] == [LoggedScan, LoggedReset] * 2
    for box, reset in zip(boxes, found[1::2], strict=True):
        np.testing.assert_array_equal(box, (reset.minimum, reset.maximum))


def test_a_file_of_which_a_chunk_is_no_chunk_any_more_is_refused(tmp_path) -> None:
    path = written(tmp_path / "whole.mcap", scan(0), scan(1, misses=2))
    data = bytearray(path.read_bytes())
    at = next(at for at in range(30, 60) if data[at] == 6)  # the code of a chunk
    data[at] ^= 0x55
    path.write_bytes(data)
    with pytest.raises(DamagedMapFileError, match="it has 0 messages, of 5"):
        list(read_segment(path))


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_a_damaged_file_is_refused_or_reads_as_it_was(tmp_path_factory, data) -> None:
    folder = tmp_path_factory.mktemp("log")
    whole = written(folder / "whole.mcap", scan(0), scan(1, misses=2)).read_bytes()
    at = data.draw(st.integers(0, len(whole) - 1))
    cut = data.draw(st.booleans())
    changed = whole[:at] + (b"" if cut else bytes([whole[at] ^ 0x55]) + whole[at + 1 :])
    path = folder / "changed.mcap"
    path.write_bytes(changed)
    with suppress(DamagedMapFileError):
        found = list(read_segment(path))
        assert [each.stamp_ns for each in found] == [10**18, 10**18 + 1]


def test_the_history_leaves_out_what_the_map_went_back_from(tmp_path) -> None:
    for after, epoch in ((0, 3), (3, 7), (7, 9), (3, 12), (12, 20)):
        (tmp_path / segment_name(after, epoch)).touch()
    (tmp_path / ".unfinished-1.mcap").touch()
    found = segments(tmp_path)
    assert [one.epoch for one in found] == [3, 7, 9, 12, 20]
    assert [one.epoch for one in history(found)] == [3, 12, 20]
    assert [one.epoch for one in history(found[1:])] == [12, 20]  # the oldest has gone
    assert history([]) == []


def test_a_history_ends_even_where_names_go_in_circles() -> None:
    found = [Segment(5, 9, Path("a")), Segment(9, 5, Path("b")), Segment(11, 11, Path("c"))]
    assert len(history(found)) <= 3
    assert history(found[:2]) == found[:2]


def test_a_folder_that_is_not_there_has_no_files(tmp_path) -> None:
    assert segments(tmp_path / "none") == []
