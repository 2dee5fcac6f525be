"""Subscribing to topics, known or found, and the queue of messages for the thread that reads."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import zenoh
import zenoh.ext

from triquad_tools.ros2 import topics
from triquad_tools.ros2.node import Node, watch_tokens
from triquad_tools.ros2.options import Feed, Role, TopicChoice

_log = logging.getLogger("triquad_ros2")
_MAX_FOUND = 1000  # topics that are remembered, whether they are wanted or not
_ASK_S = 2.0
_SUBSCRIPTION = topics.Delivery(reliable=False)  # which suits every publisher
# Static transforms are published once: who publishes them keeps them for those that come later.
_HISTORY = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=100)


@dataclass(frozen=True, eq=False)
class Arrival:
    """A message as it arrived."""

    role: Role
    topic_name: str
    payload: zenoh.ZBytes
    arrived_ns: int  # nanoseconds since 1970, by this machine's clock
    attachment: bytes = b""
    type_name: str = ""  # where the key or a token tells it

    @property
    def nbytes(self) -> int:
        """About the memory that it takes."""
        return len(self.payload) + 1000


@dataclass(frozen=True)
class Limits:
    """The most that may wait."""

    messages: int
    nbytes: int


class MessageQueue:
    """Scans, and other messages, which go first: transforms must not wait behind large clouds."""

    def __init__(self, scans: Limits, others: Limits, dropped: Callable[[Arrival], None]) -> None:
        """``dropped`` is called with each message that nobody will read."""
        self._limits = {True: scans, False: others}  # by whether they bring scans
        self._waiting: dict[bool, deque[Arrival]] = {True: deque(), False: deque()}
        self._bytes = {True: 0, False: 0}  # of these
        self._dropped = dropped
        self._changed = threading.Condition()
        self._closed = False

    def put(self, arrival: Arrival) -> None:
        """Add a message; where they are too many, the oldest go. Never waits."""
        is_scan = arrival.role.brings_scans
        line, limits = self._waiting[is_scan], self._limits[is_scan]
        gone = []
        with self._changed:
            line.append(arrival)
            self._bytes[is_scan] += arrival.nbytes
            while len(line) > limits.messages or self._bytes[is_scan] > limits.nbytes:
                gone.append(self._oldest(is_scan))
            self._changed.notify()
        for each in gone:
            self._dropped(each)

    def take(self, timeout_s: float) -> Arrival | None:
        """Return the message to read next; None if none comes in time, or the queue is closed."""
        with self._changed:
            others, scans = self._waiting[False], self._waiting[True]
            self._changed.wait_for(lambda: self._closed or others or scans, timeout_s)
            return None if self._closed or not (others or scans) else self._oldest(not others)

    def _oldest(self, is_scan: bool) -> Arrival:
        arrival = self._waiting[is_scan].popleft()
        self._bytes[is_scan] -= arrival.nbytes
        return arrival

    @property
    def is_closed(self) -> bool:
        """Whether no more messages are given out."""
        return self._closed

    def close(self) -> None:
        """Give out no more messages."""
        with self._changed:
            self._closed = True
            self._changed.notify()


@dataclass
class TopicListener:
    """Forwards what arrives on all wanted topics."""

    session: zenoh.Session
    choice: TopicChoice
    node: Node
    arrived: Callable[[Arrival], None]  # called from several threads, and must not wait

    def __post_init__(self) -> None:
        self._lock = threading.Lock()
        self._closed = False
        self._subscribers: dict[str, Any] = {}  # by key
        self._found: set[topics.Announcement] = set()
        self._types: dict[str, str] = {}  # of wanted topics that were found
        for feed in self.choice.feeds():
            self._open(feed)
        self._watches = watch_tokens(
            self.session, self.choice.domain, topics.End.PUBLISHER, self._find
        )

    @property
    def found(self) -> list[topics.Topic]:
        """The published topics, wanted or not."""
        with self._lock:
            return list({each.topic for each in self._found})

    def close(self) -> None:
        """Forward nothing more."""
        for watch in self._watches:
            watch.undeclare()
        with self._lock:
            self._closed = True
        for subscriber in self._subscribers.values():
            subscriber.undeclare()

    def _open(self, feed: Feed) -> None:
        with self._lock:
            if feed.key in self._subscribers or self._closed:
                return
            receive = partial(self._receive, feed)
            self._subscribers[feed.key] = (
                zenoh.ext.declare_advanced_subscriber(
                    self.session, feed.key, receive, history=_HISTORY
                )
                if feed.role is Role.TF_STATIC
                else self.session.declare_subscriber(feed.key, receive)
            )

    def _receive(self, feed: Feed, sample: zenoh.Sample) -> None:
        name = feed.topic_name or topics.rmw_topic_name(str(sample.key_expr))
        attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
        kind = feed.type_name or self._types.get(name, "")
        self.arrived(Arrival(feed.role, name, sample.payload, time.time_ns(), attachment, kind))

    def _find(self, announcement: topics.Announcement) -> None:
        topic = announcement.topic
        role = self.choice.wants(topic)
        if role is Role.TF_STATIC and announcement.type_hash == topics.ANY_HASH:
            self._ask_old_bridges(topic.name)
        with self._lock:
            if announcement in self._found or len(self._found) >= _MAX_FOUND:
                return
            self._found.add(announcement)
        if role is None:
            return
        self._types[topic.name] = topic.type_name
        _log.info("found %s (%s)", topic.name, topic.type_name)
        if announcement.type_hash == topics.ANY_HASH:
            self._open(Feed(role, topics.bridge_key(topic.name), topic.name))
        else:
            # Drivers that publish only while there is a subscriber learn it from this.
            what = topics.Announcement(topics.End.SUBSCRIPTION, topic, announcement.type_hash)
            self.node.announce(what, _SUBSCRIPTION)

    def _ask_old_bridges(self, topic_name: str) -> None:
        """Fetch what bridges up to 1.5 published before anybody subscribed."""
        feed = Feed(Role.TF_STATIC, topics.old_bridge_cache(topic_name), topic_name)
        replies = self.session.get(
            feed.key,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=_ASK_S,
        )
        for reply in replies:
            if reply.ok is not None:
                self._receive(feed, reply.ok)
