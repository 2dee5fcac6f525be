"""The mesh of a box that is being watched: only what changed travels."""

import math
import threading
import time
from collections.abc import Mapping
from types import MappingProxyType

from triquad_format.wire import keys
from triquad_format.wire.messages import TileUpdates

from triquad_client.errors import ClosedError, RequestTimeoutError
from triquad_client.mesh.followed_mesh import FollowedMesh, MeshUpdate
from triquad_client.mesh.mesh_tiles import KnownTiles, MeshTile, TileIndex, unpacked
from triquad_client.net.call import Ask, Call, ask, offload

_LONGEST_WAIT_S = 20.0  # of one request; then it is sent again


class WatchClosedError(ClosedError):
    """The watch was closed, before the call or meanwhile."""

    def __init__(self) -> None:
        super().__init__("the watch is closed")


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
        """Whether the last reply left nothing waiting."""
        return self._followed.complete

    @property
    def level(self) -> int:
        """Level of detail."""
        return self._followed.level

    def known_tiles(self) -> KnownTiles:
        """The tiles, for a later watch to go on with."""
        return self._followed.known_tiles()

    def _next(self, timeout_s: float | None) -> Call[MeshUpdate | None]:
        ends = math.inf if timeout_s is None else time.monotonic() + timeout_s
        while True:
            left_s = max(0.0, ends - time.monotonic())
            update = yield from self._update(min(left_s, _LONGEST_WAIT_S))
            if update.changed or update.removed:
                return update
            if time.monotonic() >= ends:
                return None

    def _catch_up(self, timeout_s: float) -> Call[None]:
        ends = time.monotonic() + timeout_s
        wait_s = 0.0
        while not (update := (yield from self._update(wait_s))).complete:
            if time.monotonic() > ends:
                raise RequestTimeoutError(f"the mesh is not complete after {timeout_s:g} s")
            # Nothing came although there is something: the bandwidth is used up for a while.
            wait_s = 0.0 if update.changed else 1.0

    def _update(self, wait_s: float) -> Call[MeshUpdate]:
        """What one reply changed: nothing where that of another call came first."""
        before = self._followed
        request = Ask(
            keys.TILE_UPDATES,
            before.request(wait_s),
            TileUpdates,
            background=True,
            server_wait_s=wait_s,
        )
        reply = yield from ask(request)
        tiles = yield from offload(lambda _: unpacked(reply))
        changed = {tile.index: tile for tile in tiles}
        after = before.after(reply, changed)
        with self._changing:
            if self._followed is not before:  # by what is known now, the reply may be old
                return MeshUpdate(
                    changed=(),
                    removed=(),
                    epoch=self._followed.epoch,
                    complete=self._followed.complete,
                    size_bytes=0,
                )
            self._followed = after
        removed = tuple(sorted(before.tiles.keys() - after.tiles.keys()))
        return MeshUpdate(
            changed=tuple(changed),
            removed=removed,
            epoch=after.epoch,
            complete=after.complete,
            size_bytes=len(reply.data),
        )
