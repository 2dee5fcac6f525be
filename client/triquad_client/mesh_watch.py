"""Following the mesh of a box: only what changed travels."""

import math
import secrets
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType, TracebackType

import numpy as np
import zenoh
from numpy.typing import NDArray
from triquad_format import draco, keys
from triquad_format.messages import TileUpdates, TileUpdatesRequest
from triquad_query.errors import TriquadError

from triquad_client.blocking import BlockingDriver
from triquad_client.call import Ask, ask
from triquad_client.connection import Connection
from triquad_client.errors import (
    BadReplyError,
    InvalidInputError,
    RequestTimeoutError,
)
from triquad_client.mesh import Mesh
from triquad_client.mesh_tiles import HeldTiles, MeshTile, TileIndex, unpacked
from triquad_client.welding import joined

LEVELS = 3
"""Levels of detail: cells of level ``l`` are ``2**l`` times as large as those of level 0."""

_LONGEST_WAIT_S = 20.0  # of one request; then it is sent again
_REPLY_BYTES = 1_000_000
_MAX_HELD = 100_000  # the server's limit; of more the rest travels again


@dataclass(frozen=True)
class MeshUpdate:
    """What one reply changed."""

    changed: tuple[TileIndex, ...]  # tiles that are new or different
    removed: tuple[TileIndex, ...]
    epoch: int
    complete: bool  # all tiles show this epoch
    size: int  # bytes of the tiles as they came


class MeshWatch:
    """The mesh tiles of a box, kept up to date by :meth:`next`; nothing is asked in between.

    Use it in a ``with`` statement, or :meth:`close` it. Where a method raises, what is held stays,
    and it may be called again: after the server was restarted, all tiles are fetched anew, and the
    old ones stay until then.
    """

    def __init__(
        self,
        connection: Connection,
        minimum: NDArray[np.float64],
        maximum: NDArray[np.float64],
        level: int,
        max_bytes_per_s: int | None,
        held: HeldTiles | None,
    ) -> None:
        """Use :meth:`Client.watch_mesh`."""
        _check(level, max_bytes_per_s, held)
        self._connection = connection
        self._cancellation = zenoh.CancellationToken()
        self._driver = BlockingDriver(connection, self._cancellation)
        self._minimum, self._maximum = minimum, maximum
        self._level = level
        self._rate = max_bytes_per_s or 0
        self._name = secrets.token_hex(8)
        self._asking = threading.Lock()
        self._closed = False
        self._server = "" if held is None else held.server
        self._side_m = math.nan if held is None else held.tile_side_m
        self._tiles = {} if held is None else self._within(held)
        self._void: set[TileIndex] = set()  # of a server that is no more
        self._revision = 0
        self._epoch = 0
        self._complete = False

    def __enter__(self) -> "MeshWatch":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def __iter__(self) -> Iterator[MeshUpdate]:
        """Updates as they come, until the watch is closed."""
        while not self._closed:
            update = self.next(_LONGEST_WAIT_S)
            if update is not None:
                yield update

    @property
    def tiles(self) -> Mapping[TileIndex, MeshTile]:
        """The tiles as of the last update, by their indices."""
        return MappingProxyType(self._tiles)

    @property
    def complete(self) -> bool:
        """Whether the last reply left nothing waiting."""
        return self._complete

    @property
    def level(self) -> int:
        """Level of detail."""
        return self._level

    def next(self, timeout: float | None = None) -> MeshUpdate | None:
        """Wait for the next change.

        Args:
            timeout: seconds; ``None``: for ever.

        Returns:
            What changed; ``None`` where nothing did in that time, or the watch was closed.

        Raises:
            RefusedError: the server refused.
            RequestTimeoutError: it does not answer.
        """
        ends = math.inf if timeout is None else time.monotonic() + timeout
        while not self._closed:
            left_s = max(0.0, ends - time.monotonic())
            try:
                update = self._ask(min(left_s, _LONGEST_WAIT_S))
            except TriquadError:
                if self._closed:
                    return None
                raise
            if update.changed or update.removed:
                return update
            if time.monotonic() >= ends:
                break
        return None

    def catch_up(self, timeout: float = 60.0) -> None:
        """Fetch all that changed until now.

        Args:
            timeout: seconds.

        Raises:
            RequestTimeoutError: that was not all of it.
        """
        ends = time.monotonic() + timeout
        wait_s = 0.0
        while not (update := self._ask(wait_s)).complete:
            if time.monotonic() > ends:
                raise RequestTimeoutError(f"the mesh is not complete after {timeout:g} s")
            # Nothing came although there is something: the bandwidth is used up for a while.
            wait_s = 0.0 if update.changed else 1.0

    def mesh(self) -> Mesh:
        """The tiles as one mesh, faces by their centroids within the bounds."""
        triangles = [(tile.origin + tile.vertices, tile.faces) for tile in self._tiles.values()]
        if not triangles:
            return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32), self._epoch)
        return Mesh(*joined(triangles, self._side_m, self._minimum, self._maximum), self._epoch)

    def held(self) -> HeldTiles:
        """The tiles, for a later watch to go on with."""
        tiles = {index: tile for index, tile in self._tiles.items() if index not in self._void}
        return HeldTiles(self._server, self._level, self._side_m, tiles)

    def close(self) -> None:
        """End: :meth:`next` returns ``None``, and iteration ends, also in other threads."""
        self._closed = True
        self._cancellation.cancel()

    def _within(self, held: HeldTiles) -> dict[TileIndex, MeshTile]:
        """The held tiles that meet the bounds: others would not be kept up to date."""
        side_m = held.tile_side_m
        return {
            index: tile
            for index, tile in held.tiles.items()
            if (tile.origin <= self._maximum).all()
            and (tile.origin + side_m >= self._minimum).all()
        }

    def _ask(self, wait_s: float) -> MeshUpdate:
        with self._asking:
            request = Ask(
                keys.TILE_UPDATES,
                self._request(wait_s),
                TileUpdates,
                background=True,
                at_least_s=wait_s + self._connection.timeout_s,
            )
            return self._applied(self._driver.run(ask(request)))

    def _request(self, wait_s: float) -> TileUpdatesRequest:
        # Until all is known, the server has to be told what is held; then the revision says it.
        known = (
            []
            if self._complete
            else [tile for index, tile in self._tiles.items() if index not in self._void][
                :_MAX_HELD
            ]
        )
        return TileUpdatesRequest(
            self._minimum,
            self._maximum,
            self._level,
            self._server,
            self._revision,
            np.array([tile.index for tile in known], np.int32).reshape(-1, 3),
            np.array([tile.version for tile in known], np.int64),
            _REPLY_BYTES,
            wait_s,
            self._name,
            self._rate,
            draco.AVAILABLE,
        )

    def _applied(self, reply: TileUpdates) -> MeshUpdate:
        if not (math.isfinite(reply.tile_side_m) and reply.tile_side_m > 0):
            raise BadReplyError(f"tiles of side {reply.tile_side_m}")
        changed = unpacked(reply)
        if reply.restart:
            self._void = set(self._tiles)
        self._side_m = reply.tile_side_m
        removed = {(x, y, z) for x, y, z in reply.removed.tolist()}
        for tile in changed:
            self._tiles[tile.index] = tile
            self._void.discard(tile.index)
        if reply.complete:
            removed |= self._void
            self._void = set()
        removed &= self._tiles.keys()
        for index in removed:
            del self._tiles[index]
        self._void -= removed
        self._server, self._revision = reply.server, reply.revision
        self._epoch, self._complete = reply.epoch, reply.complete
        return MeshUpdate(
            tuple(tile.index for tile in changed),
            tuple(sorted(removed)),
            reply.epoch,
            reply.complete,
            len(reply.data),
        )


def check_level(level: int) -> int:
    """``level`` where there is such a level of detail.

    Raises:
        InvalidInputError: there is not.
    """
    if type(level) is not int or not 0 <= level < LEVELS:
        raise InvalidInputError(f"level = {level!r}: use 0 to {LEVELS - 1}")
    return level


def _check(level: int, max_bytes_per_s: int | None, held: HeldTiles | None) -> None:
    check_level(level)
    if max_bytes_per_s is not None and (type(max_bytes_per_s) is not int or max_bytes_per_s < 1):
        raise InvalidInputError(f"max_bytes_per_s = {max_bytes_per_s!r}: use 1 or more, or None")
    if held is not None and held.level != level:
        raise InvalidInputError(f"the held tiles are of level {held.level}, not {level}")
