"""The node as which the bridge shows in the graph of ROS: ``/triquad``."""

import itertools
from typing import Any

import zenoh

from triquad_tools.ros2.topics import (
    Announcement,
    Delivery,
    Entity,
    bridge_token,
    rmw_node_token,
    rmw_token,
)

NODE_NAME = "triquad"


class Node:
    """Announces what the bridge publishes and subscribes to, until it is closed."""

    def __init__(self, session: zenoh.Session, domain: int) -> None:
        self._session = session
        self._domain = domain
        self._session_id = str(session.zid())
        self._numbers = itertools.count()
        self._tokens: list[Any] = []
        self._declare(rmw_node_token(domain, self._entity()))

    def announce(self, what: Announcement, delivery: Delivery) -> None:
        """Announce it to nodes of rmw_zenoh."""
        self._declare(rmw_token(self._domain, self._entity(), what, delivery))

    def announce_to_bridges(self, what: Announcement, delivery: Delivery) -> None:
        """Announce it to zenoh-bridge-ros2dds."""
        self._declare(bridge_token(self._session_id, what, delivery))

    def close(self) -> None:
        """Withdraw all announcements."""
        for token in reversed(self._tokens):
            token.undeclare()

    def _entity(self) -> Entity:
        return Entity(self._session_id, NODE_NAME, next(self._numbers))

    def _declare(self, token: str) -> None:
        self._tokens.append(self._session.liveliness().declare_token(token))
