"""Clients that follow the mesh: their pending requests, the replies to them, and sending these.

A client that does not read, or is slow, holds up no other.
"""

import logging
import math
import threading
import time
from collections import Counter, OrderedDict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from triquad_format.errors import FormatError, RefusedError
from triquad_format.records.arrays import Ints
from triquad_format.wire import keys
from triquad_format.wire.limits import MAX_KNOWN_TILES
from triquad_format.wire.messages import TileUpdates, TileUpdatesRequest
from triquad_map.box import check_box
from triquad_map.compiled.mesh.tile_lattice import TileIndex, TileLattice, check_level
from triquad_map.compiled.priority import lower_priority

from triquad_server.fair_queue import Owner
from triquad_server.mesh.tile_cache import CachedTile
from triquad_server.process.threads import NICENESS, submit
from triquad_server.settings import MeshSettings

_log = logging.getLogger(__name__)

_SENDERS = 16
"""Replies on their way at a time: clients that do not read them hold up no others."""

MAX_CLIENTS = 1024
"""Of more, those heard of longest ago are forgotten."""

BURST_S = 1.0
"""A client that asked for nothing for so long may be sent as many seconds' worth at once."""

MAX_HELD_BYTES = 64_000_000
"""Of all requests that are held together; more are refused, of the client that has most."""

_FOLLOWER_BYTES, _KNOWN_BYTES = 4096, 300
"""Of one that is held, and of each tile that it names as known."""


class PendingRequest(Protocol):
    """A request for updates, which gets one answer: of the network, or of this process."""

    @property
    def size(self) -> int:
        """Bytes that it takes while it is held."""

    @property
    def owner(self) -> Owner:
        """Whose it is."""

    def read(self, kind: type[TileUpdatesRequest]) -> TileUpdatesRequest:
        """What is asked for."""

    def answer(self, message: TileUpdates) -> None:
        """Give the answer."""

    def refuse(self, code: str, text: str) -> None:
        """Say why there is none."""

    def fail(self, error: Exception) -> None:
        """Say that an internal error, which is being handled, is why there is none."""


@dataclass(eq=False)
class Follower:
    """A pending request for what changed."""

    request: PendingRequest
    asks: TileUpdatesRequest
    needs_epoch: int  # the newest epoch when it came
    deadline_s: float  # monotonic
    bytes_per_s: float
    restart: bool  # it knows tiles of another server: they are void
    known_to: int  # it knows everything up to this revision
    known: dict[TileIndex, int]  # versions of tiles that it has whatever the revision
    nothing_at: tuple[int, int] | None = None  # state of the cache that had nothing for it

    @property
    def nbytes(self) -> int:
        """Memory that it takes while it is held, about."""
        return _FOLLOWER_BYTES + 2 * self.request.size + len(self.known) * _KNOWN_BYTES


def new_follower(
    request: PendingRequest,
    asks: TileUpdatesRequest,
    *,
    server: str,
    epoch: int,
    settings: MeshSettings,
) -> Follower:
    """A request that begins to wait; it has passed its checks.

    ``server`` is the name that replies carry, ``epoch`` the newest.
    """
    restart = asks.server not in ("", server)
    known = zip(asks.known.tolist(), asks.known_versions.tolist(), strict=True)
    limits = (settings.client_bytes_per_s, asks.max_bytes_per_s)
    return Follower(
        request=request,
        asks=asks,
        needs_epoch=epoch,
        deadline_s=time.monotonic() + min(asks.timeout_s, settings.update_timeout_max_s),
        bytes_per_s=min((limit for limit in limits if limit), default=math.inf),
        restart=restart,
        known_to=0 if restart else asks.revision,
        known={} if restart else {(x, y, z): version for (x, y, z), version in known},
    )


def check_updates(asks: TileUpdatesRequest, server: str, revision: int) -> None:
    """Refuse a request for changes with a field out of range.

    ``server`` is the name that this server's replies carry, ``revision`` the newest of them.

    Raises:
        RefusedError: a field is out of range, or too many tiles are known.
    """
    check_box(asks.minimum, asks.maximum)
    check_level(asks.level)
    try:
        keys.check_name("client", asks.client)
    except FormatError as error:
        raise RefusedError("bad_request", str(error)) from error
    # Written so that NaN is refused as well.
    if not 0 <= asks.timeout_s < math.inf:
        raise RefusedError(
            "bad_request", f"timeout_s = {asks.timeout_s} is not a time: use 0 or more"
        )
    if asks.max_bytes < 1 or asks.max_bytes_per_s < 0:
        raise RefusedError(
            "bad_request",
            f"max_bytes = {asks.max_bytes}, max_bytes_per_s = {asks.max_bytes_per_s}: "
            "use at least 1, and at least 0",
        )
    _check_held(asks)
    newest = revision if asks.server == server else 0
    if asks.server in ("", server) and not 0 <= asks.revision <= newest:
        raise RefusedError(
            "bad_request",
            f"revision = {asks.revision} was never given by server {asks.server!r}: "
            "use that of the reply before, or 0",
        )


def _check_held(asks: TileUpdatesRequest) -> None:
    if len(asks.known) != len(asks.known_versions):
        raise RefusedError(
            "bad_request", f"{len(asks.known_versions)} versions of {len(asks.known)} known tiles"
        )
    if len(asks.known) > MAX_KNOWN_TILES:
        raise RefusedError(
            "too_large", f"{len(asks.known)} known tiles exceed the limit of {MAX_KNOWN_TILES}"
        )


@dataclass
class TileReply:
    """Tiles on their way to one follower."""

    complete: bool  # nothing more waits
    revision: int  # up to which the follower knows everything once it has the reply
    removed: list[TileIndex] = field(default_factory=list)
    tiles: list[CachedTile] = field(default_factory=list)
    data: list[bytes] = field(default_factory=list)  # of each tile

    def fits(self, data: bytes, limit: float) -> bool:
        """Whether a tile may be added: the first always may."""
        return not data or not self.data or sum(map(len, self.data)) + len(data) <= limit

    def add(self, tile: CachedTile, data: bytes) -> None:
        """Add a tile with its bytes; one without faces is to be removed."""
        self.revision = tile.revision
        if tile.empty:
            self.removed.append(tile.index)
        else:
            self.tiles.append(tile)
            self.data.append(data)

    def message(
        self, *, server: str, epoch: int, restart: bool, lattice: TileLattice
    ) -> TileUpdates:
        """The reply as it travels."""
        return TileUpdates(
            server=server,
            revision=self.revision,
            epoch=epoch,
            complete=self.complete,
            restart=restart,
            tile_side_m=lattice.tile_side_m,
            cell_m=lattice.cell_m,
            tiles=_indices([tile.index for tile in self.tiles]),
            versions=np.array([tile.version for tile in self.tiles], np.int64),
            sizes=np.array([len(data) for data in self.data], np.int64),
            data=b"".join(self.data),
            removed=_indices(self.removed),
        )


def _indices(tiles: list[TileIndex]) -> Ints:
    return np.array(tiles, np.int32).reshape(-1, 3)


@dataclass
class _Bucket:
    """What a client may be sent; less than nothing where it was sent more."""

    tokens: float  # bytes
    at_s: float


class Bandwidth:
    """How many bytes a second each client is sent: a token bucket for each, by its name.

    Times are monotonic seconds. A rate of infinity sets no limit.
    """

    def __init__(self) -> None:
        self._buckets: OrderedDict[str, _Bucket] = OrderedDict()

    def may_send(self, client: str, bytes_per_s: float, now_s: float) -> bool:
        """Whether it is time to send to a client again."""
        return math.isinf(bytes_per_s) or self._filled(client, bytes_per_s, now_s).tokens > 0

    def spend(self, client: str, count: int, bytes_per_s: float, now_s: float) -> None:
        """Count bytes that are sent to a client."""
        if not math.isinf(bytes_per_s):
            self._filled(client, bytes_per_s, now_s).tokens -= count

    def _filled(self, client: str, bytes_per_s: float, now_s: float) -> _Bucket:
        most = bytes_per_s * BURST_S
        bucket = self._buckets.setdefault(client, _Bucket(most, now_s))
        self._buckets.move_to_end(client)
        bucket.tokens = min(most, bucket.tokens + bytes_per_s * (now_s - bucket.at_s))
        bucket.at_s = now_s
        if len(self._buckets) > MAX_CLIENTS:
            self._buckets.popitem(last=False)
        return bucket


class TileSenders:
    """Sends replies, on threads of its own, to each client as fast as it may be sent to."""

    def __init__(self) -> None:
        self._bandwidth = Bandwidth()
        self._lock = threading.Lock()
        self._sending: Counter[Owner] = Counter()  # replies that are not sent yet
        self._threads = ThreadPoolExecutor(
            _SENDERS, "tile-sender", initializer=lower_priority, initargs=(NICENESS,)
        )

    @property
    def sending(self) -> int:
        """Replies that are not sent yet."""
        with self._lock:
            return self._sending.total()

    def is_sending_to(self, follower: Follower) -> bool:
        """Whether a reply to the same client is on its way: the next waits until it has arrived."""
        with self._lock:
            return self._sending[follower.request.owner] > 0

    def may_send(self, follower: Follower) -> bool:
        """Whether it is time to send to a follower's client again. For one thread."""
        return self._bandwidth.may_send(
            follower.asks.client, follower.bytes_per_s, time.monotonic()
        )

    def send(self, follower: Follower, reply: TileUpdates) -> None:
        """Send a reply, in the background. For the thread that asks :meth:`may_send`."""
        self._bandwidth.spend(
            follower.asks.client, len(reply.data), follower.bytes_per_s, now_s=time.monotonic()
        )
        with self._lock:
            self._sending[follower.request.owner] += 1
        submit(self._threads, self._answer, follower, reply)

    def refuse(self, follower: Follower, code: str, text: str) -> None:
        """Refuse a request, in the background."""
        submit(self._threads, follower.request.refuse, code, text)

    def close(self) -> None:
        """Send what is left, and end."""
        self._threads.shutdown()

    def _answer(self, follower: Follower, reply: TileUpdates) -> None:
        try:
            follower.request.answer(reply)
        except Exception:
            _log.exception("a reply to a follower of the mesh could not be sent")
        finally:
            with self._lock:
                self._sending -= Counter([follower.request.owner])
