"""What a robot publishes makes the same scans as the bag that recorded it, or is refused, too."""

from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support import servers
from support.poses import shifted
from support.recordings.bags import Recorded, messages_for, write_bag
from support.ros.ros_bridge import bridging
from support.ros.ros_robot import T0, robot
from support.ros_messages import CAMERA_INFO, CLOUD, COMPRESSED_IMAGE, IMAGE, TF
from triquad_format.wire import codec
from triquad_format.wire.messages import Scan
from triquad_tools.recordings.opening import Selection, open_recording
from triquad_tools.recordings.recording import ReadingOptions

ROS = messages_for("mcap")
COUNT = 4
STAMPS = [T0 + number * 10**8 for number in range(COUNT)]
POSES = [shifted(x=float(number)) for number in range(COUNT)]
MATRIX = np.array([[40.0, 0, 19.5], [0, 40.0, 14.5], [0, 0, 1]])
SPHERE = servers.sphere(1000)
METRES = np.linspace(1.0, 5.0, 1200, dtype=np.float32).reshape(30, 40)


@pytest.fixture(scope="module")
def near() -> Iterator[str]:
    with servers.running_service() as endpoint:
        yield endpoint


@pytest.fixture
def endpoint(name: str, near: str) -> Iterator[str]:
    """A server; coordinates of UTM need one of their own, since a map's origin stays."""
    with servers.running_service() if name == "utm" else nullcontext(near) as endpoint:
        yield endpoint


def cloud_drive(
    times: str = "",
    points: NDArray[np.float32] = SPHERE,
    place_m: tuple[float, float, float] = (0, 0, 0),
) -> Iterator[Recorded]:
    """A lidar at a place; its points have times, in a field of this name."""
    start = shifted(*place_m)
    offsets = {times: np.linspace(0, 5e7, len(points)).astype(np.uint32)} if times else {}
    for stamp, pose in zip(STAMPS, POSES, strict=True):
        yield Recorded("/tf", TF, stamp, ROS.tf(stamp, ("odom", "lidar", start @ pose)))
        cloud = ROS.cloud(points, stamp, "lidar", offsets)
        yield Recorded("/points", CLOUD, stamp + 1, cloud)
    last = STAMPS[-1] + 10**8
    yield Recorded("/tf", TF, last, ROS.tf(last, ("odom", "lidar", start @ shifted(x=COUNT))))


def depth_drive(form: str) -> Iterator[Recorded]:
    for stamp, pose in zip(STAMPS, POSES, strict=True):
        yield Recorded("/tf", TF, stamp, ROS.tf(stamp, ("odom", "optical", pose)))
        info = ROS.camera_info(METRES.shape, MATRIX, stamp)
        if form == "distorted":
            info.d = np.array([0.1, -0.05, 0.0, 0.0, 0.0])
        yield Recorded("/camera/camera_info", CAMERA_INFO, stamp + 1, info)
        if form == "largest":
            units = (METRES * 1000).astype(np.uint16)
            units[5, 5:10], units[6, 5:10] = 65535, 0
            yield Recorded(DEPTH[form], IMAGE, stamp + 2, ROS.image(units, "16UC1", stamp))
            continue
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
    "largest": "/camera/image_rect_raw",
}
REFUSED = {"standing": "registered", "base_frame": "ray_origin", "millimetres": "units"}
INSIDE = np.array([1.0, 0.0, 1.8], np.float32)  # where a driver leaves rays without a return
DRIVES = {
    "cloud": lambda: cloud_drive(),
    "times": lambda: cloud_drive("time_offset_ns"),
    "utm": lambda: cloud_drive(place_m=(450_000.25, 5_400_000.5, 400.0)),
    "empty_rays": lambda: cloud_drive(points=np.concatenate([SPHERE, np.tile(INSIDE, (50, 1))])),
    "standing": standing_drive,
    "base_frame": lambda: cloud_drive(points=np.concatenate([SPHERE, 2 * SPHERE])),
    "millimetres": lambda: cloud_drive(points=1000 * SPHERE),
    **{form: (lambda form=form: depth_drive(form)) for form in DEPTH},
}


@pytest.mark.parametrize("name", DRIVES)
def test_scans_are_those_of_the_bag(endpoint: str, name: str, tmp_path: Path) -> None:
    drive = list(DRIVES[name]())
    bag = open_recording(write_bag(tmp_path / "bag", "mcap", drive), ReadingOptions(stride=1))
    recorded = list(Selection(bag, range(len(bag.entries)), 0.0, (0.0, 0.0, 0.0), "").scans())
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
    assert len(heard) == len(recorded) == (0 if name in REFUSED else COUNT)
    assert dropped == ({REFUSED[name]: COUNT} if name in REFUSED else {})
    for live, scan in zip(heard, recorded, strict=True):
        np.testing.assert_allclose(live.world_from_sensor, scan.world_from_sensor, atol=1e-9)
        np.testing.assert_allclose(live.points, scan.points, atol=1e-6)
