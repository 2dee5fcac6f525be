"""Following the mesh of a box: only what changed travels."""

import math
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from types import MappingProxyType

import numpy as np
import zenoh
from triquad_format.errors import TriquadError
from triquad_format.wire.bounds import MAX_COUNT
from triquad_format.wire.limits import MAX_TILES_ASKED
from triquad_format.wire.mesh_messages import MeshRequest

from triquad_client import checks
from triquad_client.errors import ClosedError, RequestTimeoutError, brief_errors
from triquad_client.mesh.followed_mesh import (
    FollowedMesh,
    KnownTiles,
    MeshTile,
    MeshUpdate,
    TileIndex,
)
from triquad_client.mesh.mesh import Mesh
from triquad_client.net.connection import Answering, cancellable

_PAUSE_S = 0.25  # until the server is asked again what is new
_TILES_EACH = 32  # that are fetched at once, some in each request
_BYTES_PER_TILE = 50_000  # as many tiles are fetched at once as take less than a second


class _WatchClosedError(ClosedError):
    """The watch was closed, before the call or meanwhile."""

    def __init__(self) -> None:
        super().__init__("the watch is closed")


class WatchedTiles(ABC):
    """The tiles of a watch as of its last update."""

    @abstractmethod
    def _now(self) -> FollowedMesh:
        """Return what is known."""

    @property
    def tiles(self) -> Mapping[TileIndex, MeshTile]:
        """The tiles as of the last update, by their indices; later updates do not change it."""
        return MappingProxyType(self._now().tiles)

    @property
    def complete(self) -> bool:
        """True where nothing was left to be fetched."""
        return self._now().complete

    @property
    def level(self) -> int:
        """Level of detail."""
        return self._now().level

    @property
    def cell_m(self) -> float:
        """Side of the cells of which faces are made; NaN before the first update."""
        return self._now().served.cell_m

    @property
    def tile_side_m(self) -> float:
        """Side of the tiles; NaN before the first update, unless tiles were known."""
        return self._now().served.tile_side_m

    def known_tiles(self) -> KnownTiles:
        """Return the tiles, for a later watch to go on with."""
        return self._now().known_tiles()


@brief_errors
class MeshWatch(WatchedTiles):
    """The mesh tiles of a box, kept up to date by :meth:`next`; nothing is asked in between.

    Use it in a ``with`` statement, or :meth:`close` it. Where a method raises, the tiles stay,
    and it may be called again: after the server was restarted, all tiles are fetched again, and the
    old ones stay until then. Several threads may use it: each change is reported to one of them.
    """

    def __init__(
        self, server: Answering, followed: FollowedMesh, max_bytes_per_s: int | None
    ) -> None:
        """Use :meth:`Client.watch_mesh`."""
        self._server = server
        self._followed = followed
        self._max_bytes_per_s: float = math.inf
        self._tiles_each = _TILES_EACH
        if max_bytes_per_s is not None:
            limit = checks.count("max_bytes_per_s", max_bytes_per_s, MAX_COUNT, least=1)
            self._max_bytes_per_s = limit
            self._tiles_each = max(1, min(limit // _BYTES_PER_TILE, _TILES_EACH))
        self._told_s = -math.inf  # monotonic: when the server was last asked which tiles changed
        self._ready_s = 0.0  # monotonic: until then, the bandwidth is used up
        self._changing = threading.Lock()
        self._closed = threading.Event()
        self._asking: list[zenoh.CancellationToken] = []

    def __repr__(self) -> str:
        return f"MeshWatch({len(self.tiles)} tiles{'' if self.complete else ', more to come'})"

    def __enter__(self) -> "MeshWatch":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[MeshUpdate]:
        """Yield updates as they come, until the watch is closed."""
        return iter(self.next, None)

    def next(self, timeout_s: float | None = None) -> MeshUpdate | None:
        """Wait for the next change.

        Args:
            timeout_s: how long; ``None``: for ever.

        Returns:
            What changed; ``None`` where nothing did in that time, or the watch was closed.

        Raises:
            RefusedError: the server refused.
            RequestTimeoutError: it does not answer.
        """
        ends = math.inf if timeout_s is None else checks.deadline(timeout_s)
        with suppress(_WatchClosedError), self._cancelled_by_close() as token:
            self._wait_until(min(self._ready_s, ends), token)
            while time.monotonic() >= self._ready_s:
                update = self._update()
                if update.changed or update.removed:
                    return update
                if time.monotonic() >= ends:
                    break
                self._wait_until(min(max(self._ready_s, self._asks_s()), ends), token)
        return None

    def catch_up(self, timeout_s: float = 60.0) -> None:
        """Fetch all that changed until now.

        Raises:
            RequestTimeoutError: that was not all of it.
            ClosedError: the watch was closed.
        """
        started, ends = time.monotonic(), checks.deadline(timeout_s)
        with self._cancelled_by_close() as token:
            while True:
                self._wait_until(min(self._ready_s, ends), token)
                update = self._update() if time.monotonic() >= self._ready_s else None
                if update is not None and update.complete and self._told_s >= started:
                    return
                if update is None or time.monotonic() > ends:
                    raise RequestTimeoutError(f"the mesh is not complete after {timeout_s:g} s")
                self._wait_until(min(self._asks_s(), ends), token)

    def mesh(self) -> Mesh:
        """Return the tiles as one mesh, faces by their centroids within the bounds."""
        return self._followed.mesh()

    def close(self) -> None:
        """End: :meth:`next` returns ``None``, and iteration ends, also in other threads."""
        with self._changing:
            self._closed.set()
            for token in self._asking:
                token.cancel()

    def _now(self) -> FollowedMesh:
        return self._followed

    def _wait_until(self, time_s: float, token: zenoh.CancellationToken) -> None:
        """Wait until a monotonic time, or until the call was cancelled or the watch is closed.

        Raises:
            ClosedError: it was closed.
        """
        while (left_s := time_s - time.monotonic()) > 0 and not token.is_cancelled:
            if self._closed.wait(min(left_s, _PAUSE_S)):
                raise _WatchClosedError

    def _asks_s(self) -> float:
        """Return when to ask next, monotonic: at once where there is something to be fetched."""
        return time.monotonic() + (0.0 if self._followed.pending else _PAUSE_S)

    def _update(self) -> MeshUpdate:
        """Return what one step changed: nothing where that of another call came first."""
        before = followed = self._followed
        told_s = self._told_s
        if not before.pending or time.monotonic() >= told_s + _PAUSE_S:
            told_s = time.monotonic()
            followed = before.told(self._server.ask(before.changes_request()))
        some = followed.pending[: self._tiles_each]
        requests = [
            MeshRequest(np.array(some[first : first + MAX_TILES_ASKED], np.int32), 0, before.level)
            for first in range(0, len(some), MAX_TILES_ASKED)
        ]
        size = 0
        for request, reply in zip(requests, self._server.replies(requests), strict=True):
            followed = followed.fetched(request, reply)
            size += len(reply.data)
        with self._changing:
            since_s = max(self._ready_s, time.monotonic())
            self._ready_s = since_s + size / self._max_bytes_per_s
            now = self._followed
            if now is not before:  # by what is known now, the replies may be old
                return MeshUpdate((), (), now.epoch, complete=now.complete, size_bytes=0)
            self._followed, self._told_s = followed, told_s
        return MeshUpdate(
            changed=tuple(index for index in some if index in followed.tiles),
            removed=tuple(sorted(before.tiles.keys() - followed.tiles.keys())),
            epoch=followed.epoch,
            complete=followed.complete,
            size_bytes=size,
        )

    @contextmanager
    def _cancelled_by_close(self) -> Iterator[zenoh.CancellationToken]:
        """Let closing end what is asked meanwhile, with an error that says so; yield the token."""
        with cancellable() as token:
            with self._changing:
                if self._closed.is_set():
                    raise _WatchClosedError
                self._asking.append(token)
            try:
                yield token
            except TriquadError as error:
                if self._closed.is_set():
                    raise _WatchClosedError from error
                raise
            finally:
                with self._changing:
                    self._asking.remove(token)
