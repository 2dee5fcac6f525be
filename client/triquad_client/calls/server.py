"""Calls that concern the server itself: how it is doing, checkpoints, and forgetting."""

from dataclasses import replace

from triquad_format.printable import printable
from triquad_format.wire.messages import (
    CheckpointInfo,
    CheckpointRequest,
    ResetReply,
    ResetRequest,
    ServerStatus,
    StatusRequest,
)
from triquad_format.wire.metrics_messages import MetricsRequest, ServerMetrics

from triquad_client import checks
from triquad_client.checks import Bounds
from triquad_client.net.connection import Connection


class ServerCalls:
    """The calls that concern the server itself."""

    _connection: Connection

    def status(self) -> ServerStatus:
        """Return how the server is doing."""
        return self._connection.ask(StatusRequest())

    def metrics(self) -> ServerMetrics:
        """Return how the server is doing, in figures: requests and their times, queues, memory.

        Counts and times only grow while a server runs: take the difference of two answers.
        """
        return self._connection.ask(MetricsRequest())

    def checkpoint(self) -> CheckpointInfo:
        """Have the server write the map to its store now.

        Raises:
            RefusedError: ``store``, where it cannot be written.
        """
        return self._connection.ask(CheckpointRequest())

    def reset(self, bounds: Bounds | None = None) -> ResetReply:
        """Forget what was learnt within ``bounds``.

        A server with a store first writes the map as it is to a checkpoint, which stays until
        its setting ``store.keep_resets`` has been exceeded by later resets.

        Args:
            bounds: corners of a box, metres, map frame; ``None``: everything is forgotten.

        Returns:
            ``epoch``: the first without it. ``kept_epoch``: the checkpoint of the map before;
            ``None`` where there is none. ``undo``: how to go back to it, or why one cannot.

        Raises:
            RefusedError: ``store``, where the map as it is cannot be kept: nothing is forgotten.
        """
        reply = self._connection.ask(ResetRequest(*checks.box(bounds)))
        return reply if reply.undo is None else replace(reply, undo=printable(reply.undo))
