"""A topic that the bridge publishes, for nodes of rmw_zenoh and for zenoh-bridge-ros2dds."""

import hashlib
import itertools
import threading
import time
from dataclasses import dataclass

import zenoh

from triquad_tools.ros2 import topics
from triquad_tools.ros2.node import Node, watch_tokens


@dataclass(frozen=True)
class _Key:
    publisher: zenoh.Publisher
    identity: bytes | None  # that messages of rmw_zenoh carry

    @property
    def is_followed(self) -> bool:
        return bool(self.publisher.matching_status.matching)  # type: ignore[attr-defined]


@dataclass
class TopicPublisher:
    """Publishes to all subscribers; notices new ones by their tokens: they lack what was sent."""

    session: zenoh.Session
    node: Node
    topic: topics.Topic
    domain: int
    delivery: topics.Delivery

    def __post_init__(self) -> None:
        self._hash = topics.type_hash(self.topic.type_name)
        self._lock = threading.Lock()
        self._numbers = itertools.count(1)
        self._keys: dict[str, _Key] = {}
        self._came = threading.Event()  # a subscriber did
        self._open_rmw(self._hash)
        if self._open(topics.bridge_key(self.topic.name), None):
            what = topics.Announcement(topics.End.PUBLISHER, self.topic, self._hash)
            self.node.announce_to_bridges(what, self.delivery)
        self._watches = watch_tokens(
            self.session, self.domain, topics.End.SUBSCRIPTION, self._appeared
        )

    def close(self) -> None:
        """Publish no more."""
        for watch in self._watches:
            watch.undeclare()
        for key in self._keys.values():
            key.publisher.undeclare()

    @property
    def is_followed(self) -> bool:
        """Return whether there is any subscriber."""
        return any(key.is_followed for key in self._all_keys())

    def has_newcomers(self) -> bool:
        """Return whether any subscriber came since this was last called."""
        if not self._came.is_set():
            return False
        self._came.clear()
        return True

    def put(self, payload: bytes) -> None:
        """Publish a message, CDR."""
        number, now_ns = next(self._numbers), time.time_ns()
        for key in self._all_keys():
            if key.is_followed:
                attachment = key.identity and topics.ATTACHMENT.pack(
                    number, now_ns, 16, key.identity
                )
                key.publisher.put(payload, attachment=attachment)

    def _all_keys(self) -> list[_Key]:
        with self._lock:
            return list(self._keys.values())

    def _appeared(self, who: topics.Announcement) -> None:
        if who.topic != self.topic:
            return
        if who.type_hash == topics.NO_HASH:
            self._open_rmw(topics.NO_HASH)
        self._came.set()

    def _open_rmw(self, type_hash: str) -> None:
        key = topics.rmw_key(self.domain, self.topic, type_hash)
        if self._open(key, hashlib.blake2b(key.encode(), digest_size=16).digest()):
            what = topics.Announcement(topics.End.PUBLISHER, self.topic, type_hash)
            self.node.announce(what, self.delivery)

    def _open(self, key: str, identity: bytes | None) -> bool:
        """Publish under a key from now on; return False if that is done already."""
        with self._lock:
            if key in self._keys:
                return False
            # Large messages that may be dropped are lost without need. Last of all, since a
            # publisher that waits for a slow subscriber delays others of its priority.
            publisher = self.session.declare_publisher(
                key,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.BACKGROUND,
            )
            self._keys[key] = _Key(publisher, identity)
            return True
