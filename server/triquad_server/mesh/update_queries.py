"""Answers queries of which mesh tiles changed, and makes those that are out of date."""

import time

import numpy as np
from triquad_format.errors import RefusedError
from triquad_format.records.arrays import Ints
from triquad_format.wire.limits import MAX_KNOWN_TILES
from triquad_format.wire.mesh_messages import TileUpdates, TileUpdatesRequest
from triquad_map.mesh.tile_lattice import TileIndex, check_level
from triquad_map.questions.checks import check_box

from triquad_server.epochs.epoch import Epoch
from triquad_server.epochs.history import EpochHistory
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.mesh.tile_level import CachedTile, TileDelta

MAX_REQUEST_BYTES = 20 * MAX_KNOWN_TILES + 16_384  # of a request: 20 bytes of each known tile
_REPLY_BYTES = 1_000_000  # bytes of the tiles of one reply; a single tile may be larger
_SLICE_S = 0.2  # time for which tiles are made for one request, then for the next
_GIVE_WAY_S = 0.1  # seconds that the making of tiles waits for queries before each, at most
_MAX_REFRESH_SHARE = 4
"""Searches for changed tiles take at most one part in this many of the time."""


class UpdateQueries:
    """Answers, one at a time, which tiles differ from those that a client has.

    A request is answered at once, if need be with nothing: a client that follows the mesh asks
    again after a while.
    """

    def __init__(self, epochs: EpochHistory, cache: TileCache, server: str) -> None:
        """Make the handler; ``server`` is the name that replies carry."""
        self._epochs = epochs
        self._cache = cache
        self._server = server
        self._next_refresh_s = 0.0  # monotonic

    def updates(self, request: TileUpdatesRequest) -> TileUpdates:
        """Return what is new to a client, as much of it as fits.

        Raises:
            RefusedError: a field is out of range, or too many tiles are known.
        """
        self._check(request)
        newest = self._epochs.newest
        self._refresh(newest)
        delta = self._delta(request)
        if delta.to_make and (not delta.ready or delta.known_to < delta.revision):
            self._make(request.level, delta.missing or delta.outdated)
            delta = self._delta(request)
        return self._reply(request, delta, is_current=self._cache.epoch >= newest.number)

    def _restarts(self, request: TileUpdatesRequest) -> bool:
        """Return whether what the client has is of another server, and void."""
        return request.server not in ("", self._server)

    def _refresh(self, newest: Epoch) -> None:
        """Find what changed, if there may be something and the time for it is there."""
        started = time.monotonic()
        if newest.number > self._cache.epoch and started >= self._next_refresh_s:
            self._cache.refresh(newest)
            now = time.monotonic()
            self._next_refresh_s = now + _MAX_REFRESH_SHARE * (now - started)

    def _make(self, level: int, indices: list[TileIndex]) -> None:
        """Make tiles for a moment; queries come first."""
        ends_s = time.monotonic() + _SLICE_S
        left = dict.fromkeys(indices)
        while left and time.monotonic() < ends_s:
            self._epochs.give_way(_GIVE_WAY_S)
            for index in self._cache.make_some(level, left):
                del left[index]

    def _delta(self, request: TileUpdatesRequest) -> TileDelta:
        """Return what is new to the client."""
        known: dict[TileIndex, int] = {}
        known_to = 0
        if not self._restarts(request):
            rows = zip(request.known.tolist(), request.known_versions.tolist(), strict=True)
            known, known_to = {(x, y, z): version for (x, y, z), version in rows}, request.revision
        return self._cache.delta(
            request.level, request.minimum, request.maximum, known_to=known_to, known=known
        )

    def _reply(
        self, request: TileUpdatesRequest, delta: TileDelta, *, is_current: bool
    ) -> TileUpdates:
        """Return a reply with as many of the tiles as it may have, at least one."""
        limit, size = min(request.max_bytes, _REPLY_BYTES), 0
        tiles: list[CachedTile] = []
        data: list[bytes] = []
        removed = list(delta.removed)
        restart = self._restarts(request)
        complete, revision = not delta.to_make, 0 if restart else request.revision
        for tile in delta.ready:
            encoded = b"" if tile.empty else self._encoded(request.level, tile)
            if encoded is None or (data and encoded and size + len(encoded) > limit):
                complete = False
                break
            revision = min(tile.revision, delta.known_to)
            if tile.empty:
                removed.append(tile.index)
            else:
                size += len(encoded)
                tiles.append(tile)
                data.append(encoded)
        lattice = self._cache.lattice(request.level)
        return TileUpdates(
            server=self._server,
            revision=delta.revision if complete else revision,
            epoch=self._cache.epoch,
            complete=complete and is_current,
            restart=restart,
            tile_side_m=lattice.tile_side_m,
            cell_m=lattice.cell_m,
            tiles=_indices([tile.index for tile in tiles]),
            versions=np.array([tile.version for tile in tiles], np.int64),
            sizes=np.array([len(part) for part in data], np.int64),
            data=b"".join(data),
            removed=_indices(removed),
        )

    def _encoded(self, level: int, tile: CachedTile) -> bytes | None:
        """Return the bytes of a tile; None if they were dropped and the tile has others now."""
        data = self._cache.data(level, tile)
        if data is not None:
            return data
        self._epochs.give_way(_GIVE_WAY_S)
        if self._cache.make(level, tile.index).revision != tile.revision:
            return None
        return self._cache.data(level, tile)

    def _check(self, request: TileUpdatesRequest) -> None:
        """Refuse a request with a field out of range."""
        check_box(request.minimum, request.maximum)
        check_level(request.level)
        if request.max_bytes < 1:
            raise RefusedError("bad_request", f"max_bytes = {request.max_bytes}: use at least 1")
        if len(request.known) != len(request.known_versions):
            raise RefusedError(
                "bad_request",
                f"{len(request.known_versions)} versions of {len(request.known)} known tiles",
            )
        if len(request.known) > MAX_KNOWN_TILES:
            raise RefusedError(
                "too_large",
                f"{len(request.known)} known tiles exceed the limit of {MAX_KNOWN_TILES}",
            )
        newest = self._cache.revision if request.server == self._server else 0
        if not self._restarts(request) and not 0 <= request.revision <= newest:
            raise RefusedError(
                "bad_request",
                f"revision = {request.revision} was never given by server {request.server!r}: "
                "use that of the reply before, or 0",
            )


def _indices(tiles: list[TileIndex]) -> Ints:
    return np.array(tiles, np.int32).reshape(-1, 3)
