"""What a robot publishes makes the same scans as the bag that recorded it, or is refused, too."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support import servers
from support.poses import shifted
from support.recordings.bags import Recorded, messages_for, write_bag
from support.ros.ros_bridge import bridging
from support.ros.ros_robot import T0, robot
from support.ros_messages import CAMERA_INFO, CLOUD, COMPRESSED_IMAGE, IMAGE, TF
from triquad_format.wire import codec
from triquad_format.wire.messages import Scan
from triquad_tools.recordings.opening import open_recording
from triquad_tools.recordings.recording import ReadingOptions

ROS = messages_for("mcap")
COUNT = 4
STAMPS = [T0 + number * 10**8 for number in range(COUNT)]
POSES = [shifted(x=float(number)) for number in range(COUNT)]
MATRIX = np.array([[40.0, 0, 19.5], [0, 40.0, 14.5], [0, 0, 1]])
METRES = np.linspace(1.0, 5.0, 1200, dtype=np.float32).reshape(30, 40)


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with servers.running_service() as endpoint:
        yield endpoint


def cloud_drive(times: str = "") -> Iterator[Recorded]:
    points = servers.sphere(1000)
    offsets = {times: np.linspace(0, 5e7, len(points)).astype(np.uint32)} if times else {}
    for stamp, pose in zip(STAMPS, POSES, strict=True):
        yield Recorded("/tf", TF, stamp, ROS.tf(stamp, ("odom", "lidar", pose)))
        cloud = ROS.cloud(points, stamp, "lidar", offsets)
        yield Recorded("/points", CLOUD, stamp + 1, cloud)
    last = STAMPS[-1] + 10**8
    yield Recorded("/tf", TF, last, ROS.tf(last, ("odom", "lidar", shifted(x=float(COUNT)))))


def depth_drive(form: str) -> Iterator[Recorded]:
    for stamp, pose in zip(STAMPS, POSES, strict=True):
        yield Recorded("/tf", TF, stamp, ROS.tf(stamp, ("odom", "optical", pose)))
        info = ROS.camera_info(METRES.shape, MATRIX, stamp)
        if form == "distorted":
            info.d = np.array([0.1, -0.05, 0.0, 0.0, 0.0])
        yield Recorded("/camera/camera_info", CAMERA_INFO, stamp + 1, info)
        if form == "compressed":
            message = ROS.compressed_depth((METRES * 1000).astype(np.uint16), stamp)
            yield Recorded(DEPTH[form], COMPRESSED_IMAGE, stamp + 2, message)
            continue
        metres = METRES.copy()
        metres[5, 5:8] = -np.inf, np.inf, np.nan
        yield Recorded(DEPTH[form], IMAGE, stamp + 2, ROS.image(metres, "32FC1", stamp))


def standing_drive() -> Iterator[Recorded]:
    """Clouds in the world, in a frame with a name of its own, in which the lidar moves."""
    static = ROS.tf(0, ("odom", "camera_init", np.eye(4)))
    yield Recorded("/tf_static", TF, STAMPS[0], static)
    for stamp, pose in zip(STAMPS, POSES, strict=True):
        yield Recorded("/tf", TF, stamp, ROS.tf(stamp, ("camera_init", "lidar", pose)))
        points = (servers.sphere(1000) + pose[:3, 3]).astype(np.float32)
        cloud = ROS.cloud(points, stamp, "camera_init")
        yield Recorded("/points", CLOUD, stamp + 1, cloud)


DEPTH = {
    "rep117": "/camera/image_rect",
    "distorted": "/camera/image_raw",
    "compressed": "/camera/image_rect/compressedDepth",
}
DRIVES = {
    "cloud": lambda: cloud_drive(),
    "times": lambda: cloud_drive("time_offset_ns"),
    "standing": standing_drive,
    **{form: (lambda form=form: depth_drive(form)) for form in DEPTH},
}


@pytest.mark.parametrize("name", DRIVES)
def test_scans_are_those_of_the_bag(endpoint: str, name: str, tmp_path: Path) -> None:
    drive = list(DRIVES[name]())
    bag = open_recording(write_bag(tmp_path / "bag", "mcap", drive), ReadingOptions(stride=1))
    recorded = list(bag.read(range(len(bag.entries))))
    depth = ("--depth", DEPTH[name], "--depth-stride", 1) if name in DEPTH else ()
    heard: list[Scan] = []
    with bridging(endpoint, *depth) as bridged, servers.raw_session(connect=endpoint) as ear:
        ear.declare_subscriber(
            "triquad/default/scan/*",
            lambda sample: heard.append(codec.decode(Scan, sample.payload.to_bytes())),
        )
        with robot(endpoint) as r2:
            for topic, kind, _, message in drive:
                r2.send(topic, kind, message, latched=topic == "/tf_static")
            bridged.wait_for(lambda: bridged.accounted == COUNT)
        bridged.wait_for(lambda: len(heard) == bridged.taken)
        dropped = bridged.bridge.dropped
    assert len(heard) == len(recorded) == (0 if name == "standing" else COUNT)
    assert dropped == ({"registered": COUNT} if name == "standing" else {})
    for live, scan in zip(heard, recorded, strict=True):
        np.testing.assert_allclose(live.world_from_sensor, scan.world_from_sensor, atol=1e-9)
        np.testing.assert_allclose(live.points, scan.points, atol=1e-6)
