"""The calls about the server: how it is doing, where its scans come from, checkpoints, resets."""

from __future__ import annotations

from dataclasses import replace

from triquad_format.errors import FormatError, InvalidInputError
from triquad_format.printable import printable
from triquad_format.wire import keys
from triquad_format.wire.limits import MAX_SAMPLE_POINTS
from triquad_format.wire.map_messages import CreateMapRequest, DropMapRequest
from triquad_format.wire.messages import (
    CheckpointInfo,
    CheckpointRequest,
    ResetReply,
    ResetRequest,
)
from triquad_format.wire.metrics_messages import MetricsRequest, ServerMetrics
from triquad_format.wire.source_messages import SourceReport, SourcesRequest
from triquad_format.wire.status_messages import ServerStatus, StatusRequest

from triquad_client import checks
from triquad_client.checks import Bounds
from triquad_client.net.connection import Connection, new_ticket

_NO_SOURCES = SourceReport(server="", revision=0, sources={})


class ServerCalls:
    """The calls about the server rather than about what its map holds."""

    _connection: Connection

    def sources(self, since: SourceReport | None = None, max_points: int = 5_000) -> SourceReport:
        """Return where each source of scans has been, and its newest scan.

        To follow them, give the report before: it comes back where nothing is new.

        Args:
            since: the report before; ``None``: nothing is known yet.
            max_points: 0 to 10,000: as many points of each newest scan come, evenly drawn.

        Raises:
            NoReplyError: the server may be of a release that does not know this question.
        """
        if since is not None and not isinstance(since, SourceReport):
            raise InvalidInputError(f"since = {since!r}: give what an earlier call returned")
        limit = checks.count("max_points", max_points, MAX_SAMPLE_POINTS)
        known = since or _NO_SOURCES
        reply = self._connection.ask(SourcesRequest(known.server, known.revision, limit))
        is_same = (reply.server, reply.revision) == (known.server, known.revision)
        return known if is_same else reply

    def status(self) -> ServerStatus:
        """Return how the server is doing."""
        return self._connection.ask(StatusRequest())

    def metrics(self) -> ServerMetrics:
        """Return how the server is doing, in figures: requests and their times, queues, memory.

        Counts and times only grow while a server runs: take the difference of two answers.
        """
        return self._connection.ask(MetricsRequest())

    def checkpoint(self, timeout_s: float = 600.0) -> CheckpointInfo:
        """Have the server write the map to its store now, and wait until it is there.

        Raises:
            RefusedError: ``store``, where it cannot be written.
            RequestTimeoutError: it was not after ``timeout_s``; the text says for how long the
                server has been at it, which it will finish.
        """
        return self._connection.ask_until_done(CheckpointRequest(new_ticket()), timeout_s)

    def reset(self, bounds: Bounds | None = None, timeout_s: float = 600.0) -> ResetReply:
        """Forget what was learnt within ``bounds``.

        A server with a store first writes the map as it is to a checkpoint, which stays until
        its setting ``store.keep_resets`` has been exceeded by later resets.

        Args:
            bounds: corners of a box, metres, map frame; ``None``: everything is forgotten.
            timeout_s: how long to wait for that, at most.

        Returns:
            ``epoch``: the first without it. ``kept_epoch``: the checkpoint of the map before;
            ``None`` where there is none. ``undo``: how to go back to it, or why one cannot.

        Raises:
            RefusedError: ``store``, where the map as it is cannot be kept: nothing is forgotten.
            RequestTimeoutError: not done after ``timeout_s``; the server goes on with it.
        """
        request = ResetRequest(*checks.box(bounds), new_ticket())
        reply = self._connection.ask_until_done(request, timeout_s)
        return reply if reply.undo is None else replace(reply, undo=printable(reply.undo))

    def maps(self) -> list[str]:
        """Return names of all maps that can be reached, also those of other servers."""
        return self._connection.maps()

    def create_map(self, name: str, timeout_s: float = 60.0) -> None:
        """Have the server of this map open another one, with the same settings, and wait for it.

        It has a folder of its own in the server's store; what is there of a map of this name is
        gone on with. A server that is started again with the same ``--map`` opens it, too.

        Raises:
            RefusedError: ``map_exists``, where a server in reach has a map of this name; ``store``,
                where its folder cannot be used; ``busy``, where there is no memory for it.
            InvalidInputError: no map can have this name.
        """
        request = CreateMapRequest(_map_name(name), new_ticket())
        self._connection.ask_until_done(request, timeout_s)

    def drop_map(self, name: str, timeout_s: float = 600.0) -> str | None:
        """Have the server of this map close another one of its maps, for everybody.

        With a store it writes a last checkpoint, and sets the map's folder aside.

        Returns:
            That folder on the server, ``None`` without a store. It may be deleted; in its old place
            it is what :meth:`create_map` goes on with.

        Raises:
            RefusedError: ``no_map``, where the server does not have it; ``bad_request``, where it
                is the map of this client; ``store``, where it cannot be written and goes on, or its
                folder cannot be moved: the text says which.
            InvalidInputError: no map can have this name.
        """
        request = DropMapRequest(_map_name(name), new_ticket())
        reply = self._connection.ask_until_done(request, timeout_s)
        return reply.kept if reply.kept is None else printable(reply.kept)


def _map_name(name: str) -> str:
    try:
        return keys.check_name("map", name)
    except FormatError as error:
        raise InvalidInputError(str(error)) from None
