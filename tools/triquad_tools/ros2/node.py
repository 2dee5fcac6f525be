"""The graph of ROS: the node as which the bridge shows, ``/triquad``, and the tokens of others."""

import itertools
import logging
from collections.abc import Callable
from typing import Any

import zenoh

from triquad_tools.ros2 import topics

_log = logging.getLogger("triquad_ros2")


class Node:
    """Announces what the bridge publishes and subscribes to, until it is closed."""

    def __init__(self, session: zenoh.Session, domain: int) -> None:
        self._session = session
        self._domain = domain
        self._session_id = str(session.zid())
        self._numbers = itertools.count()
        self._tokens: list[Any] = []
        self._declare(self._prefix("NN"))

    def announce(self, what: topics.Announcement, delivery: topics.Delivery) -> None:
        """Announce it to nodes of rmw_zenoh."""
        self._declare(topics.rmw_token(self._prefix(what.end.value), what, delivery))

    def announce_to_bridges(self, what: topics.Announcement, delivery: topics.Delivery) -> None:
        """Announce it to zenoh-bridge-ros2dds."""
        self._declare(topics.bridge_token(self._session_id, what, delivery))

    def close(self) -> None:
        """Withdraw all announcements."""
        for token in reversed(self._tokens):
            token.undeclare()

    def _prefix(self, kind: str) -> str:
        return topics.rmw_prefix(self._domain, self._session_id, next(self._numbers), kind)

    def _declare(self, token: str) -> None:
        self._tokens.append(self._session.liveliness().declare_token(token))


def watch_tokens(
    session: zenoh.Session,
    domain: int,
    end: topics.End,
    appeared: Callable[[topics.Announcement], None],
) -> list[Any]:
    """Report all others that have one end of a topic, existing ones first.

    ``appeared`` is called from threads of Zenoh, and must not wait for long. What is returned is to
    be undeclared.
    """
    own_chunk = f"/{session.zid()}/"

    def receive(sample: zenoh.Sample) -> None:
        token = str(sample.key_expr)
        if sample.kind != zenoh.SampleKind.PUT or own_chunk in token:
            return
        announcement = topics.read_token(token)
        try:
            if announcement is not None:
                appeared(announcement)
        except zenoh.ZError as error:  # names that cannot stand in a key
            _log.debug("%s cannot be used: %s", token, error)

    return [
        session.liveliness().declare_subscriber(key, receive, history=True)
        for key in (topics.rmw_tokens(domain, end), topics.bridge_tokens(end))
    ]
