"""Following the mesh of a box: only what changed travels."""

import math
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from types import MappingProxyType

import zenoh
from triquad_format.errors import TriquadError
from triquad_format.wire import keys
from triquad_format.wire.messages import TileUpdates

from triquad_client import checks
from triquad_client.errors import ClosedError, RequestTimeoutError
from triquad_client.mesh.followed_mesh import (
    FollowedMesh,
    KnownTiles,
    MeshTile,
    MeshUpdate,
    TileIndex,
)
from triquad_client.mesh.mesh import Mesh
from triquad_client.net.call import Ask, Call, ResultT, ask, offload
from triquad_client.net.connection import Connection, RemoteDriver
from triquad_client.net.operation import Blocking, operation

_LONGEST_WAIT_S = 20.0  # of one request; then it is sent again


class WatchClosedError(ClosedError):
    """The watch was closed, before the call or meanwhile."""


class WatchedMesh:
    """The tiles of a watch, and the calls that change them; no matter who waits for the replies."""

    def __init__(self, followed: FollowedMesh) -> None:
        self._followed = followed
        self._changing = threading.Lock()

    @property
    def tiles(self) -> Mapping[TileIndex, MeshTile]:
        """The tiles as of the last update, by their indices; later updates do not change it."""
        return MappingProxyType(self._followed.tiles)

    @property
    def complete(self) -> bool:
        """True where the last reply left nothing waiting."""
        return self._followed.complete

    @property
    def level(self) -> int:
        """Level of detail."""
        return self._followed.level

    @property
    def cell_m(self) -> float:
        """Side of the cells of which faces are made; NaN before the first update."""
        return self._followed.cell_m

    @property
    def tile_side_m(self) -> float:
        """Side of the tiles; NaN before the first update, unless tiles were known."""
        return self._followed.tile_side_m

    def known_tiles(self) -> KnownTiles:
        """Return the tiles, for a later watch to go on with."""
        return self._followed.known_tiles()

    def _next(self, timeout_s: float | None) -> Call[MeshUpdate | None]:
        ends = math.inf if timeout_s is None else checks.deadline(timeout_s)
        while True:
            left_s = max(0.0, ends - time.monotonic())
            update = yield from self._update(min(left_s, _LONGEST_WAIT_S))
            if update.changed or update.removed:
                return update
            if time.monotonic() >= ends:
                return None

    @operation
    def catch_up(self, timeout_s: float = 60.0) -> Call[None]:
        """Fetch all that changed until now.

        Raises:
            RequestTimeoutError: that was not all of it.
            ClosedError: the watch was closed.
        """
        ends = checks.deadline(timeout_s)
        wait_s = 0.0
        while not (update := (yield from self._update(wait_s))).complete:
            if time.monotonic() > ends:
                raise RequestTimeoutError(f"the mesh is not complete after {timeout_s:g} s")
            # Nothing came although there is something: the bandwidth is used up for a while.
            wait_s = 0.0 if update.changed else 1.0

    def _update(self, wait_s: float) -> Call[MeshUpdate]:
        """Return what one reply changed: nothing where that of another call came first."""
        before = self._followed
        request = before.request(wait_s)
        reply = yield from ask(
            Ask(keys.TILE_UPDATES, request, TileUpdates, background=True, server_wait_s=wait_s)
        )
        after = yield from offload(lambda _: before.after(reply))
        with self._changing:
            now = self._followed
            if now is not before:  # by what is known now, the reply may be old
                return MeshUpdate((), (), now.epoch, complete=now.complete, size_bytes=0)
            self._followed = after
        removed = tuple(sorted(before.tiles.keys() - after.tiles.keys()))
        return MeshUpdate(
            changed=tuple((x, y, z) for x, y, z in reply.tiles.tolist()),
            removed=removed,
            epoch=after.epoch,
            complete=after.complete,
            size_bytes=len(reply.data),
        )


class MeshWatch(WatchedMesh, Blocking):
    """The mesh tiles of a box, kept up to date by :meth:`next`; nothing is asked in between.

    Use it in a ``with`` statement, or :meth:`close` it. Where a method raises, the tiles stay,
    and it may be called again: after the server was restarted, all tiles are fetched again, and the
    old ones stay until then. Several threads may use it: each change is reported to one of them.
    """

    def __init__(self, connection: Connection, followed: FollowedMesh) -> None:
        """Use :meth:`Client.watch_mesh`."""
        super().__init__(followed)
        self._closed = False
        self._cancellation = zenoh.CancellationToken()
        self._driver = RemoteDriver(connection, self._cancellation)

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
        with suppress(WatchClosedError):
            return self._run(self._next(timeout_s))
        return None

    def mesh(self) -> Mesh:
        """Return the tiles as one mesh, faces by their centroids within the bounds."""
        return self._followed.mesh()

    def close(self) -> None:
        """End: :meth:`next` returns ``None``, and iteration ends, also in other threads."""
        self._closed = True
        self._cancellation.cancel()

    def _run(self, call: Call[ResultT]) -> ResultT:
        try:
            return self._driver.run(call)
        except TriquadError as error:
            if self._closed:
                raise WatchClosedError("the watch is closed") from error
            raise
