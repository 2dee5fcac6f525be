"""The mesh of a box as a follower knows it: what it asks next, and what replies make of it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from triquad_format.errors import InvalidInputError, WireError
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.wire.codec import known_origin
from triquad_format.wire.mesh_messages import (
    MeshReply,
    MeshRequest,
    TileChanges,
    TileChangesRequest,
)
from triquad_format.wire.tile_codec import TileSurface, decode_tile, decoded_bytes
from triquad_map.triangles import Triangles, joined

from triquad_client import checks
from triquad_client.checks import Bounds
from triquad_client.errors import BadReplyError, DownloadError
from triquad_client.mesh.mesh import Mesh

TileIndex = tuple[int, int, int]


@dataclass(frozen=True)
class MeshTile:
    """The mesh of one tile: its index counts sides of tiles from the map's origin."""

    index: TileIndex
    version: int  # epoch of which it is
    origin: NDArray[np.float64]  # [3] metres, map frame: the minimum corner
    vertices: NDArray[np.float32]  # [V, 3] metres, relative to the origin
    faces: NDArray[np.int32]  # [F, 3] counter-clockwise seen from free space

    @property
    def nbytes(self) -> int:
        """Bytes of memory that it takes."""
        return self.vertices.nbytes + self.faces.nbytes


@dataclass(frozen=True, eq=False)
class ServedTiles:
    """The places where one process of a server has its tiles."""

    server: str = ""  # of which process they are
    tile_side_m: float = math.nan
    cell_m: float = math.nan
    origin: Doubles = field(default_factory=lambda: np.zeros(3))  # [3] map frame: of tile 0 0 0


@dataclass(frozen=True)
class KnownTiles:
    """Tiles for a later watch to go on with.

    :meth:`MeshWatch.known_tiles` gives them, :meth:`Client.watch_mesh` takes them. They are of one
    level of one server process: where that was restarted, they are fetched again.
    """

    server: str
    level: int
    tile_side_m: float
    tiles: Mapping[TileIndex, MeshTile] = field(default_factory=dict)
    origin: Doubles = field(default_factory=lambda: np.zeros(3))  # [3] map frame: of tile 0 0 0


@dataclass(frozen=True)
class MeshUpdate:
    """The changes of one step."""

    changed: tuple[TileIndex, ...]  # tiles that are new or different
    removed: tuple[TileIndex, ...]
    epoch: int
    complete: bool  # all tiles show this epoch
    size_bytes: int  # of the tiles as they came


@dataclass(frozen=True, eq=False)
class FollowedMesh:
    """The known mesh tiles of a box; a reply gives another one."""

    minimum: Doubles  # [3] metres, map frame
    maximum: Doubles  # [3]
    level: int
    max_bytes: int  # of memory, for all tiles
    served: ServedTiles = field(default_factory=ServedTiles)  # of what reported all below
    tiles: Mapping[TileIndex, MeshTile] = field(default_factory=dict)
    empty: Mapping[TileIndex, int] = field(default_factory=dict)  # versions of tiles without faces
    stale: frozenset[TileIndex] = frozenset()  # tiles that go unless they come again
    pending: tuple[TileIndex, ...] = ()  # tiles to be fetched, in this order
    since: int = 0  # revision as of which all tiles are known
    revision: int = 0  # up to which the changes are known
    epoch: int = 0  # up to which the changes are known
    is_newest: bool = False  # that was the newest

    @classmethod
    def initial(
        cls,
        bounds: Bounds | None,
        level: int,
        known: KnownTiles | None,
        *,
        max_bytes: int,
    ) -> FollowedMesh:
        """Begin with nothing, or ``known`` tiles; arguments as of :meth:`Client.watch_mesh`.

        Raises:
            InvalidInputError: an argument cannot be used.
        """
        minimum, maximum = checks.box(bounds)
        checks.level_of_detail(level)
        empty = cls(minimum, maximum, level, max_bytes)
        if known is None:
            return empty
        if not isinstance(known, KnownTiles):
            raise InvalidInputError(
                f"known = {known!r}: give what an earlier watch's known_tiles() returned"
            )
        if known.level != level:
            raise InvalidInputError(f"the known tiles are of level {known.level}, not {level}")
        side_m = known.tile_side_m
        tiles = {  # others would not be kept up to date
            index: tile
            for index, tile in known.tiles.items()
            if (tile.origin <= maximum).all() and (tile.origin + side_m >= minimum).all()
        }
        served = ServedTiles(known.server, side_m, origin=known.origin)
        return replace(empty, served=served, tiles=tiles)

    @property
    def complete(self) -> bool:
        """True where nothing is left to be fetched."""
        return self.is_newest and not self.pending

    def changes_request(self) -> TileChangesRequest:
        """Return the question which tiles changed."""
        server = self.served.server
        return TileChangesRequest(self.minimum, self.maximum, self.level, server, self.since)

    def told(self, reply: TileChanges) -> FollowedMesh:
        """Return what is known after the reply to :meth:`changes_request`.

        Raises:
            BadReplyError: it contradicts the reply before.
        """
        origin = known_origin(reply.origin)
        served = ServedTiles(reply.server, reply.tile_side_m, reply.cell_m, origin)
        is_same = reply.server == self.served.server
        is_same &= bool((origin == self.served.origin).all())
        if is_same and reply.epoch < self.epoch:
            raise BadReplyError(f"epoch {reply.epoch} comes after epoch {self.epoch}")
        since, empty = (self.since, self.empty) if is_same else (0, {})
        rows = zip(reply.tiles.tolist(), reply.changed.tolist(), strict=True)
        changed = {(x, y, z): epoch for (x, y, z), epoch in rows}
        stale = self.stale if is_same else frozenset(self.tiles)  # all of another run of it is void
        if since == 0:  # all that there are were named
            stale |= self.tiles.keys() - changed.keys()
        known = {index: tile.version for index, tile in self.tiles.items() if index not in stale}
        known |= empty
        pending = [index for index, epoch in changed.items() if epoch > known.get(index, 0)]
        pending.sort(key=lambda index: known.get(index, 0))  # first those that are not there at all
        told = replace(
            self,
            served=served,
            empty=empty,
            stale=stale,
            pending=tuple(pending),
            since=since,
            epoch=reply.epoch,
            revision=reply.revision,
            is_newest=reply.is_newest,
        )
        return told._settled()

    def fetched(self, asked: MeshRequest, reply: MeshReply) -> FollowedMesh:
        """Return what is known after the reply about some of the pending tiles.

        Raises:
            BadReplyError: its parts do not fit together.
            DownloadError: it has more than may be kept.
        """
        new = self._unpacked(asked, reply)
        tiles = {**self.tiles, **new}
        empty = dict(self.empty)
        for index, tile in new.items():
            empty.pop(index, None)
            if not len(tile.faces):
                del tiles[index]
                empty[index] = tile.version
        pending = tuple(index for index in self.pending if index not in new)
        after = replace(
            self, tiles=tiles, empty=empty, stale=self.stale - new.keys(), pending=pending
        )
        return after._settled()

    def _settled(self) -> FollowedMesh:
        """Return the same without stale tiles, once all is known that the server told of."""
        if self.pending:
            return self
        tiles = {index: tile for index, tile in self.tiles.items() if index not in self.stale}
        return replace(self, tiles=tiles, stale=frozenset(), since=self.revision)

    def _unpacked(self, asked: MeshRequest, reply: MeshReply) -> dict[TileIndex, MeshTile]:
        """Return the tiles of a reply; errors as of :meth:`TileDecoder.decode`."""
        decoder = TileDecoder(self.max_bytes, sum(tile.nbytes for tile in self.tiles.values()))
        tiles: dict[TileIndex, MeshTile] = {}
        surfaces = decoder.decode(reply.sizes, reply.data)
        rows = zip(surfaces, asked.tiles.tolist(), reply.versions.tolist(), strict=True)
        for surface, (x, y, z), version in rows:
            tiles[x, y, z] = MeshTile(
                index=(x, y, z),
                version=version,
                origin=self.served.origin + np.array((x, y, z)) * self.served.tile_side_m,
                vertices=surface.positions(self.served.cell_m),
                faces=surface.faces,
            )
        return tiles

    def mesh(self) -> Mesh:
        """Return the tiles as one mesh, faces by their centroids within the bounds."""
        origin = self.served.origin
        tiles = (
            Triangles(tile.origin - origin + tile.vertices, tile.faces)
            for tile in self.tiles.values()
        )
        box = self.minimum - origin, self.maximum - origin
        whole = joined(tiles, self.served.tile_side_m, box).moved(origin)
        return Mesh.of(whole, self.epoch)

    def known_tiles(self) -> KnownTiles:
        """Return the tiles to go on with."""
        tiles = {index: tile for index, tile in self.tiles.items() if index not in self.stale}
        served = self.served
        return KnownTiles(served.server, self.level, served.tile_side_m, tiles, served.origin)


class TileDecoder:
    """Decodes tiles, which take a given memory and no more, in however many replies they come."""

    def __init__(self, max_bytes: int, kept_bytes: int = 0) -> None:
        """Decode up to ``max_bytes``, of which others take ``kept_bytes`` already."""
        self._max_bytes = max_bytes
        self._taken = kept_bytes

    def decode(self, sizes: Longs, data: bytes) -> Iterator[TileSurface]:
        """Yield tiles whose ``sizes`` [T] in bytes add up to ``data``, one after the other.

        Raises:
            BadReplyError: they are not valid.
            DownloadError: all take more than they may.
        """
        for size, end in zip(sizes.tolist(), np.cumsum(sizes).tolist(), strict=True):
            part = data[end - size : end]
            try:
                self._taken += decoded_bytes(part)  # before any of it is made
                if self._taken > self._max_bytes:
                    raise DownloadError(
                        f"the mesh takes more than {self._max_bytes} bytes: ask for a smaller box "
                        "or a coarser level, or connect with a larger max_download_bytes"
                    )
                yield decode_tile(part)
            except WireError as error:
                raise BadReplyError(f"a tile of the reply: {error}") from error
