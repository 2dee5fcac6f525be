"""Watching liveliness tokens of publishers and subscribers."""

import logging
from collections.abc import Callable

import zenoh

from triquad_tools.ros2.topics import Announcement, End, bridge_tokens, read_token, rmw_tokens

_log = logging.getLogger("triquad_ros2")


class TokenWatch:
    """Reports all others that have one end of a topic, existing ones first."""

    def __init__(
        self,
        session: zenoh.Session,
        domain: int,
        end: End,
        appeared: Callable[[Announcement], None],
    ) -> None:
        """``appeared`` is called from threads of the watch, and must not wait for long."""
        self._appeared = appeared
        self._own_chunk = f"/{session.zid()}/"
        self._subscribers = [
            session.liveliness().declare_subscriber(key, self._receive, history=True)
            for key in (rmw_tokens(domain, end), bridge_tokens(end))
        ]

    def close(self) -> None:
        """End the watch."""
        for subscriber in self._subscribers:
            subscriber.undeclare()

    def _receive(self, sample: zenoh.Sample) -> None:
        token = str(sample.key_expr)
        if sample.kind != zenoh.SampleKind.PUT or self._own_chunk in token:
            return
        announcement = read_token(token)
        try:
            if announcement is not None:
                self._appeared(announcement)
        except zenoh.ZError as error:  # names that cannot stand in a key
            _log.debug("%s cannot be used: %s", token, error)
