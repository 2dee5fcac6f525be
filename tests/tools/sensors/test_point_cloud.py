"""Clouds of ROS: every layout that drivers write, and those that are broken."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores
from support.ros_messages import CLOUD, RosMessages
from triquad_tools.sensors.ros.from_bytes import decode, decode_cdr
from triquad_tools.sensors.ros.point_cloud import sweep_of_cloud
from triquad_tools.sensors.ros.type_store import LIVOX
from triquad_tools.sensors.sweep import NoScanError

ROS = RosMessages()
STAMP_NS = 1_700_000_000_250_000_000


def points(count: int = 50, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)


@given(
    count=st.integers(0, 40),
    item=st.sampled_from(["f4", "f8"]),
    big_endian=st.booleans(),
    before=st.booleans(),
)
def test_points_come_out_as_they_went_in(
    count: int, item: str, big_endian: bool, before: bool
) -> None:
    expected = points(count)
    more = {"intensity": np.arange(count, dtype=np.float32), "ring": np.arange(count, dtype="u2")}
    message = ROS.cloud(expected, STAMP_NS, more=more, big_endian=big_endian, item=item)
    if before:  # fields in another order
        message.fields = message.fields[::-1]
    sweep = sweep_of_cloud(decode_cdr(ROS.encode(message, CLOUD), CLOUD))
    assert np.array_equal(sweep.points, expected)
    assert sweep.points.dtype == np.float32
    assert (sweep.stamp_ns, sweep.frame, sweep.offsets_s) == (STAMP_NS, "lidar", None)


def test_an_organised_cloud_may_have_padded_rows() -> None:
    expected = points(12)
    message = ROS.cloud(expected, STAMP_NS)
    rows = message.data.reshape(3, -1)
    message.data = np.concatenate([rows, np.full((3, 7), 99, np.uint8)], axis=1).reshape(-1)
    message.height, message.width, message.row_step = 3, 4, rows.shape[1] + 7
    assert np.array_equal(sweep_of_cloud(message).points, expected)


def test_points_that_are_not_finite_are_left_out_with_their_times() -> None:
    cloud = points(6)
    cloud[[1, 4], 0] = np.nan, np.inf
    times = np.linspace(0, 0.1, 6, dtype=np.float32)
    sweep = sweep_of_cloud(ROS.cloud(cloud, STAMP_NS, more={"time": times}))
    assert np.array_equal(sweep.points, cloud[[0, 2, 3, 5]])
    assert sweep.offsets_s is not None
    assert np.allclose(sweep.offsets_s, times[[0, 2, 3, 5]])


SWEEP_S = np.linspace(0, 0.1, 1000)
STAMP_S = STAMP_NS / 1e9


@pytest.mark.parametrize(
    ("name", "values", "expected_s"),
    [
        ("time", SWEEP_S.astype("f4"), SWEEP_S),  # Velodyne
        ("time", (SWEEP_S - 0.1).astype("f4"), SWEEP_S - 0.1),  # stamped at the end
        ("t", (SWEEP_S * 1e9).astype("u4"), SWEEP_S),  # Ouster
        ("offset_time", (SWEEP_S * 1e9).astype("u4"), SWEEP_S),  # Livox
        ("time", (SWEEP_S * 1e6).astype("f4"), SWEEP_S),  # microseconds
        ("timestamp", SWEEP_S + STAMP_S, SWEEP_S),  # Hesai, RoboSense
        ("timestamp", (SWEEP_S + STAMP_S) * 1e9, SWEEP_S),  # Livox in nanoseconds since 1970
        ("timestamp", SWEEP_S + 4000.0, SWEEP_S),  # a clock of its own, that of the lidar
        ("time_offset_ns", (SWEEP_S * 1e9).astype("u4"), SWEEP_S),
        ("offset_us", (SWEEP_S * 1e6).astype("u4"), SWEEP_S),
        ("timeOffset", SWEEP_S.astype("f4"), SWEEP_S),
        ("t_ns", (SWEEP_S * 1e6).astype("u4"), None),  # 0.1 ms: of a flash, not 0.1 s
        ("relative_time", (SWEEP_S * 1e3).astype("f4"), SWEEP_S),
        ("intensity", SWEEP_S.astype("f4"), None),
        ("t", np.zeros(1000, "u4"), None),  # written by nobody
        ("time", np.full(1000, np.nan, "f4"), None),
        ("ring", SWEEP_S.astype("f4"), None),
    ],
)
def test_the_times_of_points_are_understood(
    name: str, values: np.ndarray, expected_s: np.ndarray | None
) -> None:
    sweep = sweep_of_cloud(ROS.cloud(points(1000), STAMP_NS, more={name: values}))
    if expected_s is None:
        assert sweep.offsets_s is None
        assert sweep.note == "no point times: motion is not taken out"
    else:
        assert sweep.note == f"point times: {name}, 0.1 s"
        assert sweep.offsets_s is not None
        assert np.abs(sweep.offsets_s - expected_s).max() < 2e-6


@pytest.mark.parametrize("kind", LIVOX)
def test_a_cloud_is_not_taken_for_a_livox_message_without_points(kind: str) -> None:
    payload = ROS.encode(ROS.cloud(points(), STAMP_NS), CLOUD)
    with pytest.raises(NoScanError, match="no livox"):
        decode_cdr(payload, kind)


@pytest.mark.parametrize("release", [Stores.ROS2_JAZZY, Stores.ROS1_NOETIC])
@pytest.mark.parametrize("driver", ["livox_ros_driver", "livox_ros_driver2"])
def test_scans_of_livox_are_read_from_their_bytes(release: Stores, driver: str) -> None:
    ros, kind = RosMessages(release), f"{driver}/msg/CustomMsg"
    is_ros_1 = release is Stores.ROS1_NOETIC
    for count in (0, 1, 500):
        expected, offsets_ns = points(count), np.linspace(0, 1e8, count).astype("u4")
        expected[3:4] = 0  # no return
        payload = ros.encode(ros.livox(expected, offsets_ns, STAMP_NS, kind), kind)
        sweep = decode(payload, kind, bytes, is_ros_1=is_ros_1)
        kept = np.arange(count) != 3
        assert np.array_equal(sweep.points, expected[kept])
        assert np.allclose(sweep.offsets_s, offsets_ns[kept] / 1e9)
        assert (sweep.frame, sweep.stamp_ns) == ("livox", STAMP_NS)
    for broken in (payload[:-7], payload + b"1234567", payload[:40]):
        with pytest.raises((ValueError, struct.error)):
            decode(broken, kind, bytes, is_ros_1=is_ros_1)


def test_empty_points_do_not_spoil_absolute_times() -> None:
    times = SWEEP_S + STAMP_S
    times[::100] = 0.0
    sweep = sweep_of_cloud(ROS.cloud(points(1000), STAMP_NS, more={"timestamp": times}))
    assert sweep.offsets_s is not None
    assert np.abs(sweep.offsets_s).max() < 0.11


def test_what_is_no_cloud_of_points_is_refused_in_words() -> None:
    def refused(message: object) -> NoScanError:
        with pytest.raises(NoScanError) as caught:
            sweep_of_cloud(message)
        return caught.value

    message = ROS.cloud(points(), STAMP_NS)
    message.fields = message.fields[:2]
    assert "no field z, only x, y" in str(refused(message))

    message = ROS.cloud(points(), STAMP_NS)
    message.fields[0].datatype = 6
    error = refused(message)
    assert error.reason == "field_type"
    assert "uint32" in str(error)

    message = ROS.cloud(points(), STAMP_NS)
    message.fields[1].datatype = 77
    assert "type 77" in str(refused(message))

    for name, value in (("width", 51), ("point_step", 999), ("height", 2), ("row_step", 5)):
        message = ROS.cloud(points(), STAMP_NS)
        setattr(message, name, value)
        assert refused(message).reason == "truncated"

    message = ROS.cloud(points(), STAMP_NS)
    message.fields[2].offset = 4000
    assert "ends at byte 4004" in str(refused(message))


@given(cut=st.integers(0, 700), flips=st.lists(st.tuples(st.integers(0, 699), st.integers(0, 255))))
def test_no_bytes_do_more_than_be_refused(cut: int, flips: list[tuple[int, int]]) -> None:
    payload = bytearray(ROS.encode(ROS.cloud(points(40), STAMP_NS), CLOUD)[:cut])
    for at, value in flips:
        if at < len(payload):
            payload[at] = value
    try:
        sweep = sweep_of_cloud(decode_cdr(bytes(payload), CLOUD))
    except NoScanError:
        return
    assert sweep.points.shape[1] == 3
