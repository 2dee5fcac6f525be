"""Robots that speak ROS 2 over Zenoh, byte by byte as nodes of rmw_zenoh and bridges do."""

import hashlib
import struct
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

import zenoh
import zenoh.ext
from numpy.typing import NDArray
from support.ros_messages import (
    CAMERA_INFO,
    CLOUD,
    COMPRESSED_IMAGE,
    IMAGE,
    ODOMETRY,
    POSE,
    TF,
    RosMessages,
)
from support.servers import raw_session

Array = NDArray[Any]

SECOND = 10**9
_HEARD_S = 2.0  # for subscribers to be there
T0 = 1_700_000_000 * SECOND


class Wire(Protocol):
    """How messages of ROS travel over Zenoh."""

    def publish(self, topic: str, type_name: str, payload: bytes, latched: bool = False) -> None:
        """Publish; ``latched`` as TRANSIENT_LOCAL does, for those that come later too."""


class RmwZenoh:
    """As rmw_zenoh publishes: a typed key with a hash, and an attachment."""

    def __init__(
        self,
        session: zenoh.Session,
        messages: RosMessages,
        domain: int = 0,
        namespace: str = "",
    ) -> None:
        self._session = session
        self._messages = messages
        self._domain = domain
        self._namespace = namespace
        self._publishers: dict[str, Any] = {}
        self._tokens: list[Any] = []
        self._sent: Counter[str] = Counter()

    def publish(self, topic: str, type_name: str, payload: bytes, latched: bool = False) -> None:
        topic = self._namespace + topic
        package, _, name = type_name.split("/")
        dds = f"{package}::msg::dds_::{name}_"
        hash_ = self._messages.types.hash_rihs01(type_name)
        key = f"{self._domain}{topic}/{dds}/{hash_}"
        if key not in self._publishers:
            self._publishers[key] = _publisher(self._session, key, latched)
            qos = ":1:,1:,:,:,," if latched else "::,10:,:,:,,"
            names = f"{topic.replace('/', '%')}/{dds}/{hash_}/{qos}"
            self._tokens.append(
                self._session.liveliness().declare_token(
                    f"@ros2_lv/{self._domain}/{self._session.zid()}/0/"
                    f"{len(self._publishers)}/MP/%/%/robot/{names}"
                )
            )
            if not latched:
                _wait_until_heard(self._publishers[key])
        self._sent[topic] += 1
        identity = hashlib.blake2b(key.encode(), digest_size=16).digest()
        attachment = struct.pack("<qqB", self._sent[topic], T0, 16) + identity
        self._publishers[key].put(payload, attachment=attachment)

    def skip(self, topic: str, count: int) -> None:
        """As if ``count`` messages were lost on the way."""
        self._sent[self._namespace + topic] += count


class Bridge:
    """As zenoh-bridge-ros2dds publishes: the topic alone as the key, the type in a token."""

    def __init__(self, session: zenoh.Session, namespace: str = "", old: bool = False) -> None:
        """``old`` bridges, up to 1.5, keep latched messages in a cache of their own."""
        self._session = session
        self._namespace = namespace
        self._is_old = old
        self._caches: list[Any] = []
        self._publishers: dict[str, Any] = {}
        self._tokens: list[Any] = []

    def publish(self, topic: str, type_name: str, payload: bytes, latched: bool = False) -> None:
        key = f"{self._namespace}{topic}".lstrip("/")
        if latched and self._is_old:
            self._keep(key, payload)
        if key not in self._publishers:
            self._publishers[key] = _publisher(self._session, key, latched and not self._is_old)
            qos = f":1:{int(latched)}:0,1"
            token = f"{key.replace('/', '§')}/{type_name.replace('/', '§')}/{qos}"
            self._tokens.append(
                self._session.liveliness().declare_token(
                    f"@/{self._session.zid()}/@ros2_lv/MP/{token}"
                )
            )
            if not latched:
                _wait_until_heard(self._publishers[key])
        self._publishers[key].put(payload)

    def _keep(self, key: str, payload: bytes) -> None:
        self._caches.append(
            self._session.declare_queryable(
                f"@/{self._session.zid()}/@ros2_pub_cache/{key}",
                zenoh.handlers.Callback(lambda query: query.reply(key, payload), indirect=False),
            )
        )


def _wait_until_heard(publisher: Any) -> None:
    """What is sent before a subscription is known here is lost, as by a node that just started."""
    deadline = time.monotonic() + _HEARD_S
    while not publisher.matching_status.matching and time.monotonic() < deadline:
        time.sleep(0.01)


def _publisher(session: zenoh.Session, key: str, latched: bool) -> Any:
    block = zenoh.CongestionControl.BLOCK
    if not latched:
        return session.declare_publisher(key, congestion_control=block)
    cache = zenoh.ext.CacheConfig(max_samples=10)
    return zenoh.ext.declare_advanced_publisher(
        session, key, congestion_control=block, cache=cache, publisher_detection=True
    )


class Robot:
    """Publishes messages by kind."""

    def __init__(self, session: zenoh.Session, wire: Wire, messages: RosMessages) -> None:
        self.session = session
        self.wire = wire
        self.messages = messages

    def tf(self, second: float, *edges: tuple[str, str, Array], static: bool = False) -> None:
        message = self.messages.tf(stamp(second), *edges)
        topic = "/tf_static" if static else "/tf"
        self.send(topic, TF, message, latched=static)

    def cloud(self, second: float, points: Array, topic: str = "/points", **kinds: Any) -> None:
        self.send(topic, CLOUD, self.messages.cloud(points, stamp(second), **kinds))

    def odometry(self, second: float, pose: Array, child: str, topic: str = "/odom") -> None:
        message = self.messages.odometry(stamp(second), pose, "odom", child)
        self.send(topic, ODOMETRY, message)

    def pose(self, second: float, pose: Array, topic: str = "/pose") -> None:
        self.send(topic, POSE, self.messages.pose(stamp(second), pose, "map"))

    def depth(self, second: float, pixels: Array, topic: str = "/camera/depth") -> None:
        if topic.endswith("/compressedDepth"):
            message = self.messages.compressed_depth(pixels, stamp(second))
            self.send(topic, COMPRESSED_IMAGE, message)
        else:
            self.send(topic, IMAGE, self.messages.image(pixels, "16UC1", stamp(second)))

    def camera(self, second: float, size: tuple[int, int], matrix: Array) -> None:
        message = self.messages.camera_info(size, matrix, stamp(second))
        self.send("/camera/camera_info", CAMERA_INFO, message)

    def send(self, topic: str, type_name: str, message: Any, latched: bool = False) -> None:
        self.wire.publish(topic, type_name, self.messages.encode(message, type_name), latched)


def stamp(second: float) -> int:
    return T0 + round(second * SECOND)


@contextmanager
def robot(endpoint: str, way: str = "rmw", mode: str = "client", **options: Any) -> Iterator[Robot]:
    """A robot on a network, that speaks as rmw_zenoh (``rmw``) or a ``bridge`` does."""
    messages = RosMessages()
    with raw_session(mode, connect=endpoint, timestamps=True) as session:
        wire: Wire = (
            RmwZenoh(session, messages, **options) if way == "rmw" else Bridge(session, **options)
        )
        yield Robot(session, wire, messages)
