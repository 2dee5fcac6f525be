"""The feed of mesh tiles: requests are pending, and occupy no worker, until there are tiles."""

import logging
import math
import threading
import time

from triquad_format.errors import RefusedError
from triquad_format.wire import keys
from triquad_format.wire.limits import MAX_KNOWN_TILES
from triquad_format.wire.mesh_messages import TileUpdatesRequest
from triquad_format.wire.metrics_messages import QueueMetrics
from triquad_map.compiled.team import lower_priority
from triquad_map.mesh.tile_lattice import TileIndex

from triquad_server.epochs.history import EpochHistory
from triquad_server.mesh.followers import (
    BURST_S,
    Follower,
    PendingRequest,
    TileReply,
    check_updates,
    new_follower,
    one_too_many,
)
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.mesh.tile_level import CachedTile, TileDelta
from triquad_server.mesh.tile_senders import TileSenders
from triquad_server.process.threads import NICENESS
from triquad_server.serving.operations import Lane, Operations

_log = logging.getLogger(__name__)

_STOPPING = "the server is stopping"
_MAX_BYTES = 20 * MAX_KNOWN_TILES + 16_384  # of a request: 20 bytes of each known tile
_REPLY_BYTES = 1_000_000  # bytes of the tiles of one reply; a single tile may be larger
_KEPT_S = 5.0
"""The seconds for which an epoch is kept for making tiles after the last follower."""

_NOW_S = 0.0  # there may be something to do at once
_SLICE_S = 0.2  # time for which tiles are made for one follower, then for the next
_GIVE_WAY_S = 0.1
_REFRESH_PERIOD_S = 0.5  # between searches for changed tiles, at least
_MAX_REFRESH_SHARE = 4
"""Refreshing the cache takes at most one part in this many of the thread's time."""


class TileFeed:
    """Makes tiles and answers followers, on a thread of its own."""

    def __init__(
        self,
        cache: TileCache,
        epochs: EpochHistory,
        *,
        server: str,
        limit: int,
    ) -> None:
        """Begin to answer; ``server`` is the name that replies carry.

        At most ``limit`` requests are pending; of more, the newest of the client that has most of
        them is refused.
        """
        self._cache = cache
        self._epochs = epochs
        self._server = server
        self._limit = limit
        self._changed = threading.Condition()  # what is pending, woken, or whether to stop
        self._woken = False  # there is a new request or epoch, or a reply was sent
        self._pending: list[Follower] = []
        self._stopping = False
        self._next_refresh_s = 0.0
        self._senders = TileSenders(self._wake)
        epochs.listen(self._wake)
        self._thread = threading.Thread(target=self._run, name="meshing")
        self._thread.start()

    def serve_on(self, operations: Operations) -> None:
        """Take the requests of clients from now on."""
        operations.serve(keys.TILE_UPDATES, self.add, Lane.ADMINISTRATION, max_bytes=_MAX_BYTES)
        operations.queues["mesh_followers"] = lambda: self.queue

    @property
    def queue(self) -> QueueMetrics:
        """Return the state of the queue of followers, including those being sent to."""
        with self._changed:
            return QueueMetrics(len(self._pending) + self._senders.sending, self._limit)

    @property
    def nbytes(self) -> int:
        """Return the bytes of the followers that wait."""
        with self._changed:
            return sum(follower.nbytes for follower in self._pending)

    def close(self) -> None:
        """Refuse all pending requests, and end."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        self._thread.join()
        self._senders.close()

    def add(self, request: PendingRequest) -> None:
        """Take over a request for updates; it is answered once there are some, or in time.

        Raises:
            RefusedError: it cannot be decoded, a field is out of range, or the server is stopping.
        """
        asks = request.read(TileUpdatesRequest)
        check_updates(asks, self._server, self._cache.revision)
        follower = new_follower(
            request,
            asks,
            server=self._server,
            epoch=self._epochs.newest.number,
        )
        with self._changed:
            if self._stopping:
                raise RefusedError("timeout", _STOPPING)
            self._pending.append(follower)
            self._refuse_excess()
            self._woken = True
            self._changed.notify_all()

    def _wake(self) -> None:
        with self._changed:
            self._woken = True
            self._changed.notify_all()

    def _refuse_excess(self) -> None:
        while refused := one_too_many(self._pending, self._senders.sending, self._limit):
            row, text = refused
            self._senders.refuse(self._pending.pop(row), "busy", text)

    def _run(self) -> None:
        lower_priority(NICENESS)
        while True:
            with self._changed:
                if not self._changed.wait_for(self._is_wanted, _KEPT_S):
                    self._cache.release()
                    self._changed.wait_for(self._is_wanted)
                if self._stopping:
                    break
                pending = list(self._pending)
                self._woken = False
            again_s = min([self._refresh(), *map(self._serve_safely, pending)])
            with self._changed:
                left_s = max(0.0, min(again_s - time.monotonic(), threading.TIMEOUT_MAX))
                self._changed.wait_for(lambda: self._woken or self._stopping, left_s)
        for follower in self._pending:
            self._senders.refuse(follower, "timeout", _STOPPING)

    def _is_wanted(self) -> bool:
        return bool(self._pending) or self._stopping

    def _refresh(self) -> float:
        """Find what changed, if there may be something and a refresh is due.

        Return when to do so again, monotonic seconds; infinity: after the next epoch.
        """
        started = time.monotonic()
        newest = self._epochs.newest
        if newest.number <= self._cache.made_from:
            return math.inf
        if started < self._next_refresh_s:
            return self._next_refresh_s
        try:
            self._cache.refresh(newest)
        except Exception:
            _log.exception("an internal error, while changes of the surface were searched for")
        now = time.monotonic()
        self._next_refresh_s = now + max(_REFRESH_PERIOD_S, _MAX_REFRESH_SHARE * (now - started))
        is_current = self._epochs.newest.number <= self._cache.made_from
        return math.inf if is_current else self._next_refresh_s

    def _serve_safely(self, follower: Follower) -> float:
        """Do as :meth:`_serve`; an internal error ends this request only."""
        try:
            return self._serve(follower)
        except Exception as error:
            with self._changed:
                if follower not in self._pending:  # it was refused
                    return _NOW_S
                self._pending.remove(follower)
            follower.request.fail(error)
            return _NOW_S

    def _serve(self, follower: Follower) -> float:
        """Answer a follower, or make tiles for it, if that can be done now.

        Return when there may be more to do for it, monotonic seconds, unless something wakes the
        feed before: a new epoch, or a reply that was sent.
        """
        if self._senders.is_sending_to(follower):
            return math.inf
        state = (self._cache.epoch, self._cache.revision)
        is_current = follower.is_current(self._cache.epoch)
        if follower.nothing_at == state:
            return self._answer_if_late(follower, complete=is_current)
        ready_s = self._senders.ready_s(follower)
        if self._cache.made_from < 0 or ready_s > time.monotonic():
            return min(self._answer_if_late(follower), max(ready_s, self._next_refresh_s))
        asks = follower.asks
        delta = self._cache.delta(
            asks.level, asks.minimum, asks.maximum, known_to=follower.known_to, known=follower.known
        )
        if delta.ready or (delta.removed and not delta.to_make):
            self._send(follower, self._filled(follower, delta))
        elif delta.to_make:
            self._make(asks.level, delta.missing or delta.outdated)
        elif follower.restart and is_current:
            self._send(follower, TileReply(complete=True, revision=delta.revision))
        else:
            follower.known_to, follower.nothing_at = delta.revision, state
        return _NOW_S

    def _answer_if_late(self, follower: Follower, *, complete: bool = False) -> float:
        """Answer a follower without tiles, if its time is over; return when it is.

        ``complete``: it knows everything.
        """
        late_s = follower.late_s(self._cache.epoch)
        if time.monotonic() < late_s:
            return late_s
        self._send(follower, TileReply(complete=complete, revision=follower.known_to))
        return math.inf

    def _make(self, level: int, indices: list[TileIndex]) -> None:
        """Make tiles for a moment; queries come first."""
        ends_s = time.monotonic() + _SLICE_S
        left = dict.fromkeys(indices)
        while left and time.monotonic() < ends_s and not self._stopping:
            self._epochs.give_way(_GIVE_WAY_S)
            made = self._cache.make_some(level, left)
            for index in made:
                del left[index]

    def _filled(self, follower: Follower, delta: TileDelta) -> TileReply:
        """Return a reply with as many of the tiles as it may have, at least one."""
        limit = min(
            follower.asks.max_bytes,
            _REPLY_BYTES,
            max(1.0, follower.bytes_per_s * BURST_S),
        )
        reply = TileReply(
            complete=not delta.to_make, revision=follower.known_to, removed=delta.removed
        )
        for tile in delta.ready:
            data = b"" if tile.empty else self._encoded(follower.asks.level, tile)
            if data is None:  # its bytes differ now: a later delta has it
                reply.complete = False
            elif not reply.fits(data, limit):
                reply.complete = False
                break
            else:
                reply.add(tile, data)
        if reply.complete:
            reply.revision = delta.revision
            reply.complete = follower.is_current(self._cache.epoch)
        return reply

    def _encoded(self, level: int, tile: CachedTile) -> bytes | None:
        """Return the bytes of a tile; None if they were dropped and the tile has others now."""
        data = self._cache.data(level, tile)
        if data is not None:
            return data
        self._epochs.give_way(_GIVE_WAY_S)
        if self._cache.make(level, tile.index).revision != tile.revision:
            return None
        return self._cache.data(level, tile)

    def _send(self, follower: Follower, reply: TileReply) -> None:
        message = reply.message(
            server=self._server,
            epoch=self._cache.epoch,
            restart=follower.restart,
            lattice=self._cache.lattice(follower.asks.level),
        )
        with self._changed:  # it counts as pending or as being sent, never as neither
            if follower in self._pending:  # it was not refused meanwhile
                self._senders.send(follower, message)
                self._pending.remove(follower)
