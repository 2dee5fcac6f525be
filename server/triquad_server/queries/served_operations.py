"""The operations that a server answers: in groups, counted each."""

from collections.abc import Callable, Mapping

import zenoh
from triquad_format.wire import keys
from triquad_format.wire.limits import MAX_KNOWN_TILES
from triquad_format.wire.metrics_messages import QueueMetrics

from triquad_server.net.askers import Askers
from triquad_server.net.byte_budget import ByteBudget
from triquad_server.net.long_work import LongWork
from triquad_server.net.operation_counts import OperationCounts
from triquad_server.net.payload_limit import payload_limit
from triquad_server.net.request_handlers import (
    Handler,
    Operation,
    RequestHandlers,
    RequestLimits,
)
from triquad_server.settings import ServiceSettings

ReadQueue = Callable[[], QueueMetrics]
"""What waits in a queue now."""


_OF_POINTS = frozenset({"field", "distances", "places", "poses"})
"""The groups of operations that ask about points."""

_REPLY_BYTES = 32_000_000
"""Of all replies on their way, to clients that may not read them; a large one beyond is refused."""

_SMALL_REPLY_BYTES = 262_144
"""A reply of no more, such as a planner's, always is."""

_KNOWN_TILE_BYTES = 20
_PLAIN_BYTES = 16_384  # of a request that holds neither points nor tiles


def _largest_request(queue: str, limits: ServiceSettings) -> int:
    """Most bytes of a request of a group: what is larger is refused before it is held."""
    if queue in _OF_POINTS:
        return payload_limit(limits.max_query_points)
    if queue == "tile_updates":
        return MAX_KNOWN_TILES * _KNOWN_TILE_BYTES + _PLAIN_BYTES
    return _PLAIN_BYTES


class ServedOperations:
    """What is served of a map so far, what became of the requests, and where they wait."""

    def __init__(self, session: zenoh.Session, map_name: str, limits: ServiceSettings) -> None:
        self._session = session
        self._map_name = map_name
        self._askers = Askers(session)
        self._long_work = LongWork()
        self._replies = ByteBudget(_REPLY_BYTES, small=_SMALL_REPLY_BYTES)
        self._groups: list[RequestHandlers] = []
        self._limits = limits
        self.counts: dict[str, OperationCounts] = {}  # by operation, such as "query/sdf"
        self.queues: dict[str, ReadQueue] = {}  # by name

    @property
    def own_name(self) -> str:
        """By which the server names itself in a request, to have turns of its own."""
        return self._askers.own_name

    def serve(
        self, queue: str, handlers: Mapping[str, Handler], workers: int = 1, niceness: int = 0
    ) -> RequestHandlers:
        """Answer a group of operations from now on; no other group waits for it.

        ``queue`` is the name of what waits for them; ``niceness`` is that of the threads that
        answer, see :func:`triquad_map.compiled.priority.lower_priority`.
        """
        operations = {}
        for name, handler in handlers.items():
            counts = self.counts[name] = OperationCounts()
            operations[keys.operation_key(self._map_name, name)] = Operation(handler, counts)
        group = RequestHandlers(
            self._session,
            operations,
            self._askers,
            self._long_work,
            self._replies,
            workers=workers,
            niceness=niceness,
            limits=self._limits_of(queue),
        )
        self._groups.append(group)
        self.queues[queue] = lambda: group.queue
        return group

    def _limits_of(self, queue: str) -> RequestLimits:
        return RequestLimits(
            waiting=self._limits.request_queue,
            waiting_bytes=self._limits.request_queue_bytes,
            max_bytes=_largest_request(queue, self._limits),
            longest_s=self._limits.request_timeout_max_s,
        )

    def stop(self) -> None:
        """Refuse what waits and what comes in all groups; the end of none waits for another."""
        for group in self._groups:
            group.stop()

    def close(self) -> None:
        """End; all groups are closed by who asked for them, before."""
        self._askers.close()
