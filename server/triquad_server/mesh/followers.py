"""Clients that follow the mesh: their pending requests, and the replies to them."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from triquad_format.errors import FormatError, RefusedError
from triquad_format.records.arrays import Ints
from triquad_format.wire import keys
from triquad_format.wire.limits import MAX_KNOWN_TILES, MAX_WAIT_S
from triquad_format.wire.mesh_messages import TileUpdates, TileUpdatesRequest
from triquad_map.mesh.tile_lattice import TileIndex, TileLattice, check_level
from triquad_map.questions.checks import check_box

from triquad_server.fair_queue import Owner, first_to_go
from triquad_server.mesh.tile_level import CachedTile

BURST_S = 1.0
"""The seconds of silence after which a client may be sent as many seconds' worth at once."""

MAX_PENDING_BYTES = 64_000_000
"""The memory of all pending requests; more are refused, of the client that has most."""

_REFRESH_GRACE_S = 10.0
"""The seconds after its deadline that a request may wait for the cache to be refreshed from the
epoch that was the newest when it came; a refresh takes a fraction of this."""

_FOLLOWER_BYTES, _KNOWN_BYTES = 4096, 300
"""The memory of a pending request, and of each tile that it names as known."""


class PendingRequest(Protocol):
    """A request for updates, which gets one answer, from the network or from this process."""

    @property
    def size(self) -> int:
        """The bytes that it takes while it is pending."""

    @property
    def owner(self) -> Owner:
        """The owner of the request."""

    def read(self, kind: type[TileUpdatesRequest]) -> TileUpdatesRequest:
        """Return the decoded message of the request."""

    def answer(self, message: TileUpdates) -> None:
        """Send the answer."""

    def refuse(self, code: str, text: str) -> None:
        """Answer with an error."""

    def fail(self, error: Exception) -> None:
        """Answer that an internal error occurred, which is being handled."""


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
    known: dict[TileIndex, int]  # versions of tiles that it has, whatever the revision
    nothing_at: tuple[int, int] | None = None  # state of the cache that had nothing for it

    def is_current(self, epoch: int) -> bool:
        """Return whether ``epoch`` is no older than the newest when the request came."""
        return epoch >= self.needs_epoch

    def late_s(self, epoch: int) -> float:
        """Return when it must be answered, with tiles or not, by a cache that knows ``epoch``."""
        return self.deadline_s + (0.0 if self.is_current(epoch) else _REFRESH_GRACE_S)

    @property
    def nbytes(self) -> int:
        """The approximate memory that it takes while it is pending."""
        return _FOLLOWER_BYTES + 2 * self.request.size + len(self.known) * _KNOWN_BYTES


def new_follower(
    request: PendingRequest,
    asks: TileUpdatesRequest,
    *,
    server: str,
    epoch: int,
) -> Follower:
    """Return a pending request; it has passed its checks.

    ``server`` is the name that replies carry, ``epoch`` the newest.
    """
    restart = asks.server not in ("", server)
    known = zip(asks.known.tolist(), asks.known_versions.tolist(), strict=True)
    return Follower(
        request=request,
        asks=asks,
        needs_epoch=epoch,
        deadline_s=time.monotonic() + min(asks.timeout_s, MAX_WAIT_S),
        bytes_per_s=asks.max_bytes_per_s or math.inf,
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
    _check_known(asks)
    newest = revision if asks.server == server else 0
    if asks.server in ("", server) and not 0 <= asks.revision <= newest:
        raise RefusedError(
            "bad_request",
            f"revision = {asks.revision} was never given by server {asks.server!r}: "
            "use that of the reply before, or 0",
        )


def one_too_many(pending: Sequence[Follower], sending: int, limit: int) -> tuple[int, str] | None:
    """Return which follower is to be refused, and why: the newest of the client with most.

    It is None if, with the replies being sent, they are no more than the ``limit``, and do not
    take too much memory.
    """
    taken = sum(follower.nbytes for follower in pending)
    if len(pending) + sending > limit:
        sizes = [(follower.request.owner, 1) for follower in pending]
        text = f"{limit} followers of the mesh wait already; try later"
    elif taken > MAX_PENDING_BYTES:
        sizes = [(follower.request.owner, follower.nbytes) for follower in pending]
        text = f"followers of the mesh take {taken} bytes already: name fewer known tiles"
    else:
        return None
    return first_to_go(sizes), text


def _check_known(asks: TileUpdatesRequest) -> None:
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
    """Collects tiles for a reply to one follower."""

    complete: bool  # nothing more is pending
    revision: int  # revision up to which the follower knows everything once it has the reply
    removed: list[TileIndex] = field(default_factory=list)
    tiles: list[CachedTile] = field(default_factory=list)
    data: list[bytes] = field(default_factory=list)  # epoch of each tile

    def fits(self, data: bytes, limit: float) -> bool:
        """Return whether a tile may be added: the first always may."""
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
        """Return the message of the reply."""
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
