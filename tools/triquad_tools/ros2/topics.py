"""Topics of ROS 2 in Zenoh: their keys, and the liveliness tokens of publishers and subscribers.

There are two ways to write them: that of rmw_zenoh (its docs/design.md), and that of
zenoh-bridge-ros2dds (its liveliness_mgt.rs). Messages of rmw_zenoh have attachments, whose numbers
show how many never arrived.
"""

import struct
import threading
from dataclasses import dataclass
from enum import Enum

from triquad_tools.sensors.ros.type_store import type_store

NODE_NAME = "triquad"

ANY_HASH = "*"
NO_HASH = "TypeHashNotSupported"  # of ROS 2 Humble, which knows no hashes of types
ATTACHMENT = struct.Struct("<qqB16s")
"""The attachment: number, time, length of the identity, identity of the publisher."""

_MAX_PUBLISHERS = 256
_MAX_MISSED = 2**20  # a larger step is of a publisher that was started again, or of wrong bytes


class End(Enum):
    """An end of a topic, as tokens call it."""

    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"


@dataclass(frozen=True)
class Topic:
    """A topic and the type of its messages."""

    name: str  # with a leading slash
    type_name: str  # such as sensor_msgs/msg/PointCloud2


@dataclass(frozen=True)
class Announcement:
    """The content of a token: there is a publisher or a subscriber of a topic."""

    end: End
    topic: Topic
    type_hash: str = ANY_HASH  # as it stands in the keys of rmw_zenoh


def type_hash(type_name: str) -> str:
    """Return the hash of a type, RIHS01 (REP 2016)."""
    return str(type_store().hash_rihs01(type_name))


def rmw_key(domain: int, topic: Topic, type_hash: str = ANY_HASH) -> str:
    """Return the key of a topic in rmw_zenoh; the name may be ``/**``."""
    return f"{domain}{topic.name}/{_dds_type(topic.type_name)}/{type_hash}"


def rmw_topic_name(key: str) -> str:
    """Return the name of the topic that has a key of rmw_zenoh."""
    return "/" + "/".join(key.split("/")[1:-2])


def bridge_key(topic_name: str) -> str:
    """Return the key of a topic at a bridge, which has no type."""
    return topic_name.lstrip("/")


def old_bridge_cache(topic_name: str) -> str:
    """Return where bridges up to 1.5 answer with their last messages on a latched topic.

    Later ones, as rmw_zenoh, do so in the way of Zenoh's advanced publishers.
    """
    return f"@/*/@ros2_pub_cache/{bridge_key(topic_name)}"


def rmw_tokens(domain: int, end: End) -> str:
    """Return the key expression of all tokens of rmw_zenoh for one end of topics."""
    return f"@ros2_lv/{domain}/*/*/*/{end.value}/**"


def bridge_tokens(end: End) -> str:
    """Return the key expression of all tokens of bridges for one end of topics."""
    return f"@/*/@ros2_lv/{end.value}/**"


def read_token(key: str) -> Announcement | None:
    """Return the content of either kind of token; None if it says nothing about a topic."""
    parts = key.split("/")
    try:
        if parts[0] == "@ros2_lv" and len(parts) == 13:
            topic = Topic(parts[9].replace("%", "/"), _ros_type(parts[10]))
            return Announcement(End(parts[5]), topic, parts[11])
        if parts[0] == "@" and parts[2] == "@ros2_lv" and len(parts) == 7:
            topic = Topic("/" + parts[4].replace("§", "/"), parts[5].replace("§", "/"))
            return Announcement(End(parts[3]), topic)
    except (ValueError, IndexError):  # of another kind, as a service
        return None
    return None


@dataclass(frozen=True)
class Delivery:
    """The quality of service of messages, as in tokens."""

    reliable: bool = True
    latched: bool = False  # later subscribers get the last ones too: TRANSIENT_LOCAL
    depth: int = 10


def rmw_prefix(domain: int, session_id: str, number: int, kind: str) -> str:
    """Return the prefix of all tokens of an entity of the bridge's node in the graph of rmw_zenoh.

    ``number`` is that of an end of a topic, or 0 for the node itself, whose token, of kind ``NN``,
    is the prefix alone. It has no enclave and no namespace.
    """
    return f"@ros2_lv/{domain}/{session_id}/0/{number}/{kind}/%/%/{NODE_NAME}"


def rmw_token(prefix: str, what: Announcement, delivery: Delivery) -> str:
    """Return the token that says to nodes of rmw_zenoh what :func:`read_token` reads."""
    name = what.topic.name.replace("/", "%")
    type_key = f"{_dds_type(what.topic.type_name)}/{what.type_hash}"
    # Defaults are left out.
    kinds = f"{'' if delivery.reliable else 2}:{1 if delivery.latched else ''}"
    return f"{prefix}/{name}/{type_key}/{kinds}:,{delivery.depth}:,:,:,,"


def bridge_token(session_id: str, what: Announcement, delivery: Delivery) -> str:
    """Return the token that says to bridges what :func:`read_token` reads."""
    key = bridge_key(what.topic.name).replace("/", "§")
    type_key = what.topic.type_name.replace("/", "§")
    kinds = f":{int(delivery.reliable)}:{int(delivery.latched)}:0,{delivery.depth}"
    # DDS nodes since Iron expect the hash.
    qos = f"{kinds}:typehash={what.type_hash};"
    return f"@/{session_id}/@ros2_lv/{what.end.value}/{key}/{type_key}/{qos}"


def _dds_type(type_name: str) -> str:
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def _ros_type(dds_type: str) -> str:
    package, kind, _, name = dds_type.split("::")
    return f"{package}/{kind}/{name.removesuffix('_')}"


class SequenceGaps:
    """The last number of each publisher; for several threads."""

    def __init__(self) -> None:
        self._last: dict[bytes, int] = {}
        self._lock = threading.Lock()

    def missed(self, attachment: bytes) -> int:
        """Return how many messages of its publisher are missing before one with this attachment.

        An attachment in another form, as by old releases, is ignored, and so is a
        number below 0 or one that is too far ahead.
        """
        if len(attachment) != ATTACHMENT.size:
            return 0
        number: int
        number, _, _, publisher = ATTACHMENT.unpack(attachment)
        with self._lock:
            if len(self._last) > _MAX_PUBLISHERS:
                self._last.clear()
            last = self._last.get(publisher, number - 1)
            self._last[publisher] = number
        missed = number - last - 1
        return missed if 0 <= missed <= _MAX_MISSED and last >= 0 else 0
