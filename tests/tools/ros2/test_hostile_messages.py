"""Whatever bytes arrive on topics of ROS 2, the intake goes on, and what is lost is counted."""

from collections.abc import Iterator

import numpy as np
import pytest
from support import servers
from support.poses import shifted
from support.ros.ros_bridge import bridging
from support.ros.ros_robot import robot
from support.ros_messages import CAMERA_INFO, CLOUD, IMAGE, ODOMETRY, TF, RosMessages

MESSAGES = RosMessages()


def good_messages() -> dict[str, tuple[str, bytes]]:
    """A message of each kind, by topic."""
    points = servers.sphere(50)
    matrix = np.array([[50.0, 0, 4], [0, 50, 3], [0, 0, 1]])
    built = {
        "/points": (CLOUD, MESSAGES.cloud(points, 10**9, more={"t": np.arange(50, dtype="u4")})),
        "/tf": (TF, MESSAGES.tf(10**9, ("map", "base_link", shifted()))),
        "/tf_static": (TF, MESSAGES.tf(10**9, ("base_link", "lidar", shifted()))),
        "/odom": (ODOMETRY, MESSAGES.odometry(10**9, shifted(), "odom", "base_link")),
        "/camera/depth": (IMAGE, MESSAGES.image(np.ones((6, 8), np.uint16), "16UC1", 10**9)),
        "/camera/camera_info": (CAMERA_INFO, MESSAGES.camera_info((6, 8), matrix, 10**9)),
    }
    return {
        topic: (type_name, MESSAGES.encode(message, type_name))
        for topic, (type_name, message) in built.items()
    }


def damaged(payload: bytes, rng: np.random.Generator) -> bytes:
    """The bytes cut, with some changed, or with a length field that lies."""
    data = bytearray(payload)
    match rng.integers(4):
        case 0:
            return bytes(data[: rng.integers(len(data))])
        case 1:
            for place in rng.integers(4, len(data), 1 + rng.integers(8)):
                data[place] = rng.integers(256)
        case 2:
            place = 4 * rng.integers(1, len(data) // 4)
            data[place : place + 4] = b"\xff\xff\xff\x7f"
        case _:
            return rng.bytes(rng.integers(200))
    return bytes(data)


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with servers.running_service() as endpoint:
        yield endpoint


@pytest.mark.parametrize("poses", ["/tf", "/odom"])
def test_damaged_messages_stop_nothing(endpoint: str, poses: str) -> None:
    good = f"/good{poses}"
    chosen = ("--clouds", "/points", good, "--depth", "/camera/depth", "--poses", poses)
    rng = np.random.default_rng(5)
    with bridging(endpoint, *chosen, "--wait-s", 0.1) as bridged, robot(endpoint) as r2:
        messages = good_messages()
        for _ in range(60):
            for topic, (type_name, payload) in messages.items():
                r2.wire.publish(topic, type_name, damaged(payload, rng))
        for topic in ("/tf", "/tf_static", "/odom"):
            r2.wire.publish(topic, *messages[topic])
        r2.send(good, CLOUD, MESSAGES.cloud(servers.sphere(50), 10**9))
        name = good.strip("/").replace("/", ".")
        bridged.wait_for(lambda: name in bridged.client.sources().sources)
        dropped = bridged.bridge.dropped
    assert dropped["decode"] > 20
    assert "internal" not in dropped, dropped
