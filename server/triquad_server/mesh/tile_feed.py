"""Followers of the mesh: their requests are held, without holding up any worker, until tiles that
they do not have are there."""

import logging
import math
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from triquad_format.errors import FormatError
from triquad_format.wire import draco, keys
from triquad_format.wire.messages import TileUpdates, TileUpdatesRequest
from triquad_format.wire.tile_codec import Codec, decode_tile
from triquad_map.compiled.team import lower_priority

from triquad_server.epochs.epochs import EpochShelf
from triquad_server.epochs.gate import QueryGate
from triquad_server.errors import RequestError
from triquad_server.mesh.bandwidth import BURST_S, Bandwidth
from triquad_server.mesh.mesher import TileIndex
from triquad_server.mesh.tile_cache import ShelvedTile, TileNews, TileShelf
from triquad_server.net.request import Request
from triquad_server.net.requests import check_box, check_level
from triquad_server.settings import MeshSettings
from triquad_server.threads import PATIENCE

_log = logging.getLogger(__name__)

MAX_HELD = 100_000
"""Tiles that a request may say are held."""

_PAUSE_S = 0.1
_SLICE_S = 0.2  # tiles are made so long for one follower, then for the next
_GIVE_WAY_S = 0.1
_MAX_LOOK_SHARE = 4
"""Looking for changes takes at most one part in so many of the thread's time."""

_LOOK_GRACE_S = 10.0  # for a look at what is newer than the request; it takes a fraction of this

_SENDERS = 2  # so that a client that does not read holds up nobody


@dataclass
class _Held:
    """A request that waits."""

    request: Request
    asks: TileUpdatesRequest
    needs: int  # epoch that was the newest when it came
    deadline: float  # monotonic, seconds
    rate: float  # bytes a second
    restart: bool
    revision: int
    versions: dict[TileIndex, int]
    nothing_at: tuple[int, int] | None = None  # state of the shelf that had nothing for it


@dataclass
class _Reply:
    """Tiles on their way to one follower."""

    complete: bool
    revision: int
    tiles: list[ShelvedTile] = field(default_factory=list)
    codecs: list[Codec] = field(default_factory=list)
    data: list[bytes] = field(default_factory=list)
    removed: list[TileIndex] = field(default_factory=list)

    @property
    def size(self) -> int:
        """Bytes of its tiles."""
        return sum(map(len, self.data))


class TileFeed:
    """Makes tiles and answers followers, on a thread of its own."""

    def __init__(
        self,
        shelf: TileShelf,
        epochs: EpochShelf,
        gate: QueryGate,
        server: str,
        settings: MeshSettings,
        limit: int,
    ) -> None:
        """At most ``limit`` requests are held; ``server`` is the name that cursors carry."""
        self._shelf = shelf
        self._epochs = epochs
        self._gate = gate
        self._server = server
        self._settings = settings
        self._limit = limit
        self._bandwidth = Bandwidth()
        self._news = threading.Condition()
        self._held: list[_Held] = []
        self._sending = 0
        self._stopping = False
        self._next_look = 0.0
        self._senders = ThreadPoolExecutor(
            _SENDERS, "tile-sender", initializer=lower_priority, initargs=(PATIENCE,)
        )
        self._thread = threading.Thread(target=self._run, name="meshing")

    def start(self) -> None:
        """Begin to answer."""
        self._thread.start()

    def close(self) -> None:
        """Turn away what is held, and end."""
        with self._news:
            self._stopping = True
            self._news.notify_all()
        if self._thread.ident is not None:
            self._thread.join()
        self._senders.shutdown()

    def hold(self, request: Request, asks: TileUpdatesRequest) -> None:
        """Take over a request; it is answered once there are tiles for it, or in time.

        Raises:
            RequestError: a field is out of range, or too many are held.
        """
        self._check(asks)
        restart = asks.server not in ("", self._server)
        held = _Held(
            request,
            asks,
            self._epochs.newest.number,
            time.monotonic() + min(asks.timeout_s, self._settings.update_timeout_max_s),
            self._rate(asks),
            restart,
            0 if restart else asks.revision,
            {} if restart else _versions(asks),
        )
        with self._news:
            waiting = len(self._held) + self._sending
            if self._stopping or waiting >= self._limit:
                raise RequestError("busy", f"{waiting} followers of the mesh wait already")
            self._held.append(held)
            self._news.notify_all()

    def _rate(self, asks: TileUpdatesRequest) -> float:
        """Bytes a second that the client may be sent."""
        caps = (self._settings.client_bytes_per_s, asks.max_bytes_per_s)
        return min((cap for cap in caps if cap), default=math.inf)

    def _check(self, asks: TileUpdatesRequest) -> None:
        check_box(asks.minimum, asks.maximum)
        check_level(asks.level)
        try:
            keys.check_name("client", asks.client)
        except FormatError as error:
            raise RequestError("bad_request", str(error)) from error
        # Written so that NaN is refused as well.
        if not 0 <= asks.timeout_s < math.inf:
            raise RequestError(
                "bad_request", f"timeout_s = {asks.timeout_s} is not a time: use 0 or more"
            )
        if asks.max_bytes < 1 or asks.max_bytes_per_s < 0:
            raise RequestError(
                "bad_request",
                f"max_bytes = {asks.max_bytes}, max_bytes_per_s = {asks.max_bytes_per_s}: "
                "use at least 1, and at least 0",
            )
        if len(asks.held) != len(asks.held_versions):
            raise RequestError(
                "bad_request", f"{len(asks.held_versions)} versions of {len(asks.held)} held tiles"
            )
        if len(asks.held) > MAX_HELD:
            raise RequestError(
                "too_large", f"{len(asks.held)} held tiles exceed the limit of {MAX_HELD}"
            )
        known = self._shelf.revision if asks.server == self._server else 0
        if asks.server in ("", self._server) and not 0 <= asks.revision <= known:
            raise RequestError(
                "bad_request",
                f"revision = {asks.revision} was never given by server {asks.server!r}: "
                "use that of the reply before, or 0",
            )

    def _run(self) -> None:
        lower_priority(PATIENCE)
        while True:
            with self._news:
                if not self._held and not self._stopping:
                    self._news.wait()
                if self._stopping:
                    break
                held = list(self._held)
            self._look()
            if not [entry for entry in held if self._served(entry)]:
                with self._news:
                    if len(self._held) == len(held) and not self._stopping:
                        self._news.wait(_PAUSE_S)
        for entry in self._held:
            entry.request.refuse("timeout", "the server is stopping")

    def _look(self) -> None:
        """Look for what changed, where there may be something and it is time."""
        started = time.monotonic()
        newest = self._epochs.newest
        if newest.number <= self._shelf.epoch or started < self._next_look:
            return
        try:
            self._shelf.look(newest)
        except Exception:
            _log.exception("looking for changes of the surface met a defect")
        now = time.monotonic()
        self._next_look = now + max(
            self._settings.update_period_s, _MAX_LOOK_SHARE * (now - started)
        )

    def _served(self, entry: _Held) -> bool:
        """Whether anything was done for a request; a defect ends this request only."""
        try:
            return self._serve(entry)
        except Exception as error:
            _log.exception("a follower of the mesh met a defect")
            self._release(entry)
            entry.request.refuse("internal", f"{type(error).__name__}: {error}")
            return True

    def _serve(self, entry: _Held) -> bool:
        now = time.monotonic()
        state = (self._shelf.epoch, self._shelf.revision)
        looked = self._shelf.epoch >= entry.needs
        if entry.nothing_at == state or not self._may_send(entry, now):
            over = now >= entry.deadline + (0.0 if looked else _LOOK_GRACE_S)
            if over:
                self._send(entry, _Reply(looked and entry.nothing_at == state, entry.revision))
            return over
        asks = entry.asks
        news = self._shelf.news(
            asks.level, asks.minimum, asks.maximum, entry.revision, entry.versions
        )
        if news.ready or (news.removed and not news.to_make):
            self._send(entry, self._filled(entry, news))
            return True
        if news.to_make:
            self._make(entry, news.to_make)
            return True
        if entry.restart and looked:
            self._send(entry, _Reply(True, news.revision))
            return True
        entry.revision = news.revision
        entry.nothing_at = state
        return False

    def _may_send(self, entry: _Held, now: float) -> bool:
        return math.isinf(entry.rate) or self._bandwidth.may_send(
            entry.asks.client, entry.rate, now
        )

    def _make(self, entry: _Held, indices: list[TileIndex]) -> None:
        """Make tiles for a moment; queries come first."""
        ends = time.monotonic() + _SLICE_S
        for index in indices:
            self._gate.give_way(_GIVE_WAY_S)
            self._shelf.make(entry.asks.level, index)
            if time.monotonic() > ends or self._stopping:
                return

    def _filled(self, entry: _Held, news: TileNews) -> _Reply:
        """As many of the tiles as a reply may have, at least one."""
        most = min(entry.asks.max_bytes, self._settings.reply_bytes, max(1.0, entry.rate * BURST_S))
        reply = _Reply(not news.to_make, entry.revision, removed=news.removed)
        for tile in news.ready:
            if tile.empty:
                reply.removed.append(tile.index)
                reply.revision = tile.revision
                continue
            codec, data = self._encoded(entry, tile)
            if data is None:  # it came out different: it is news again
                reply.complete = False
                continue
            if reply.data and reply.size + len(data) > most:
                reply.complete = False
                break
            reply.tiles.append(tile)
            reply.codecs.append(codec)
            reply.data.append(data)
            reply.revision = tile.revision
        if reply.complete:
            reply.revision = news.revision
            reply.complete = self._shelf.epoch >= entry.needs
        return reply

    def _encoded(self, entry: _Held, tile: ShelvedTile) -> tuple[Codec, bytes | None]:
        """The bytes of a tile; None where they were gone and the tile has others now."""
        level = entry.asks.level
        data = self._shelf.data(level, tile)
        if data is None:
            self._gate.give_way(_GIVE_WAY_S)
            if self._shelf.make(level, tile.index).revision != tile.revision:
                return Codec.TRIQUAD, None
            data = self._shelf.data(level, tile)
        if data is not None and entry.asks.draco and draco.AVAILABLE:
            surface = decode_tile(data)
            lattice = self._shelf.lattice(level)
            positions = surface.positions(lattice.cell_m)
            compact = draco.encode_draco(positions, surface.faces, lattice.tile_side_m)
            if compact is not None:
                return Codec.DRACO, compact
        return Codec.TRIQUAD, data

    def _send(self, entry: _Held, reply: _Reply) -> None:
        """Hand a reply to the senders: a client that does not read would hold up this thread."""
        if not math.isinf(entry.rate):
            self._bandwidth.spend(entry.asks.client, reply.size, entry.rate, time.monotonic())
        self._release(entry, sending=1)
        self._senders.submit(self._answer, entry, reply, self._shelf.epoch)

    def _answer(self, entry: _Held, reply: _Reply, epoch: int) -> None:
        lattice = self._shelf.lattice(entry.asks.level)
        try:
            entry.request.answer(
                TileUpdates(
                    self._server,
                    reply.revision,
                    epoch,
                    reply.complete,
                    entry.restart,
                    lattice.tile_side_m,
                    lattice.cell_m,
                    _indices([tile.index for tile in reply.tiles]),
                    np.array([tile.version for tile in reply.tiles], np.int64),
                    np.array(reply.codecs, np.uint8),
                    np.array([len(data) for data in reply.data], np.int64),
                    b"".join(reply.data),
                    _indices(reply.removed),
                )
            )
        except Exception:
            _log.exception("a reply to a follower of the mesh could not be sent")
        finally:
            with self._news:
                self._sending -= 1

    def _release(self, entry: _Held, sending: int = 0) -> None:
        with self._news:
            self._held.remove(entry)
            self._sending += sending


def _versions(asks: TileUpdatesRequest) -> dict[TileIndex, int]:
    return {
        (x, y, z): version
        for (x, y, z), version in zip(asks.held.tolist(), asks.held_versions.tolist(), strict=True)
    }


def _indices(tiles: list[TileIndex]) -> "np.ndarray[tuple[int, int], np.dtype[np.int32]]":
    return np.array(tiles, np.int32).reshape(-1, 3)
