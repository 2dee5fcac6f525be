"""The mesh of a box as a follower knows it: what it asks next, and what a reply makes of it."""

import hashlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_format.errors import InvalidInputError, WireError
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.wire.limits import MAX_KNOWN_TILES
from triquad_format.wire.mesh_messages import TileUpdates, TileUpdatesRequest
from triquad_format.wire.reply import MAX_COUNT
from triquad_format.wire.tile_codec import TileSurface, decode_tile, decoded_bytes
from triquad_map.triangles import Triangles, joined

from triquad_client import checks
from triquad_client.checks import Bounds
from triquad_client.errors import BadReplyError, DownloadError
from triquad_client.mesh.mesh import Mesh

_REPLY_BYTES = 1_000_000

TileIndex = tuple[int, int, int]


@dataclass(frozen=True)
class MeshTile:
    """The mesh of one tile: ``tile_side_m`` times its index is its minimum corner."""

    index: TileIndex
    version: int  # epoch of which it is
    digest: str  # SHA-256 of the bytes as they came, 64 hexadecimal digits
    size_bytes: int  # as they came
    origin: NDArray[np.float64]  # [3] metres, map frame: the minimum corner
    vertices: NDArray[np.float32]  # [V, 3] metres, relative to the origin
    faces: NDArray[np.int32]  # [F, 3] counter-clockwise seen from free space

    @property
    def nbytes(self) -> int:
        """Bytes of memory that it takes."""
        return self.vertices.nbytes + self.faces.nbytes


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


@dataclass(frozen=True)
class MeshUpdate:
    """The changes by one reply."""

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
    reply_bytes: int  # of the tiles of one reply, at most
    max_bytes: int  # of memory, for all tiles
    server: str = ""  # which reported all below
    tile_side_m: float = math.nan
    cell_m: float = math.nan
    tiles: Mapping[TileIndex, MeshTile] = field(default_factory=dict)
    stale: frozenset[TileIndex] = frozenset()  # tiles of a server that is no more
    revision: int = 0
    epoch: int = 0
    complete: bool = False  # the last reply left nothing to come

    @classmethod
    def initial(
        cls,
        bounds: Bounds | None,
        level: int,
        max_bytes_per_s: int | None,
        known: KnownTiles | None,
        *,
        max_bytes: int,
    ) -> "FollowedMesh":
        """Begin with nothing, or ``known`` tiles; arguments as of :meth:`Client.watch_mesh`.

        Raises:
            InvalidInputError: an argument cannot be used.
        """
        minimum, maximum = checks.box(bounds)
        checks.level_of_detail(level)
        reply_bytes = _REPLY_BYTES
        if max_bytes_per_s is not None:
            limit = checks.count("max_bytes_per_s", max_bytes_per_s, MAX_COUNT, least=1)
            reply_bytes = min(limit, reply_bytes)
        empty = cls(minimum, maximum, level, reply_bytes, max_bytes)
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
        return replace(empty, server=known.server, tile_side_m=side_m, tiles=tiles)

    def request(self) -> TileUpdatesRequest:
        """Return what to ask."""
        # Until all is known, the server has to know which tiles are; then the revision says it.
        # Of more than may be named, the rest travels again.
        known = [] if self.complete else list(self.known_tiles().tiles.values())[:MAX_KNOWN_TILES]
        return TileUpdatesRequest(
            minimum=self.minimum,
            maximum=self.maximum,
            level=self.level,
            server=self.server,
            revision=self.revision,
            known=np.array([tile.index for tile in known], np.int32).reshape(-1, 3),
            known_versions=np.array([tile.version for tile in known], np.int64),
            max_bytes=self.reply_bytes,
        )

    def after(self, reply: TileUpdates) -> "FollowedMesh":
        """Return what is known after the reply to :meth:`request`.

        Raises:
            BadReplyError: its parts do not fit together, or it contradicts the reply before.
            DownloadError: it has more than may be kept.
        """
        self._check_order(reply)
        kept = sum(tile.nbytes for tile in self.tiles.values())
        changed = _unpacked(reply, TileDecoder(self.max_bytes, kept))
        old = frozenset(self.tiles) if reply.restart else self.stale
        stale = old - changed.keys()
        removed = {(x, y, z) for x, y, z in reply.removed.tolist()}
        if reply.complete:
            removed |= stale
        tiles = {**self.tiles, **changed}
        return replace(
            self,
            server=reply.server,
            tile_side_m=reply.tile_side_m,
            cell_m=reply.cell_m,
            tiles={index: tile for index, tile in tiles.items() if index not in removed},
            stale=stale - removed,
            revision=reply.revision,
            epoch=reply.epoch,
            complete=reply.complete,
        )

    def _check_order(self, reply: TileUpdates) -> None:
        """Refuse a reply that turns back, or that is of another server and does not say so."""
        if reply.restart or not self.server:
            return
        if reply.server != self.server:
            raise BadReplyError(f"server {reply.server!r} answers for server {self.server!r}")
        if reply.revision < self.revision or reply.epoch < self.epoch:
            raise BadReplyError(
                f"revision {reply.revision} of epoch {reply.epoch} comes after revision "
                f"{self.revision} of epoch {self.epoch}"
            )

    def mesh(self) -> Mesh:
        """Return the tiles as one mesh, faces by their centroids within the bounds."""
        tiles = (Triangles(tile.origin + tile.vertices, tile.faces) for tile in self.tiles.values())
        whole = joined(tiles, self.tile_side_m, (self.minimum, self.maximum))
        return Mesh.of(whole, self.epoch)

    def known_tiles(self) -> KnownTiles:
        """Return the tiles to go on with."""
        tiles = {index: tile for index, tile in self.tiles.items() if index not in self.stale}
        return KnownTiles(
            server=self.server, level=self.level, tile_side_m=self.tile_side_m, tiles=tiles
        )


class DecodedTile(NamedTuple):
    """A tile, and what it was decoded from."""

    data: bytes
    surface: TileSurface


class TileDecoder:
    """Decodes tiles, which take a given memory and no more, in however many replies they come."""

    def __init__(self, max_bytes: int, kept_bytes: int = 0) -> None:
        """Decode up to ``max_bytes``, of which others take ``kept_bytes`` already."""
        self._max_bytes = max_bytes
        self._taken = kept_bytes

    def decode(self, sizes: Longs, data: bytes) -> Iterator[DecodedTile]:
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
                yield DecodedTile(part, decode_tile(part))
            except WireError as error:
                raise BadReplyError(f"a tile of the reply: {error}") from error


def _unpacked(updates: TileUpdates, decoder: TileDecoder) -> dict[TileIndex, MeshTile]:
    """Return the tiles of a reply; errors as of :meth:`TileDecoder.decode`."""
    tiles: dict[TileIndex, MeshTile] = {}
    decoded = decoder.decode(updates.sizes, updates.data)
    for row, (tile, (x, y, z)) in enumerate(zip(decoded, updates.tiles.tolist(), strict=True)):
        tiles[x, y, z] = MeshTile(
            index=(x, y, z),
            version=int(updates.versions[row]),
            digest=hashlib.sha256(tile.data).hexdigest(),
            size_bytes=len(tile.data),
            origin=np.array((x, y, z)) * updates.tile_side_m,
            vertices=tile.surface.positions(updates.cell_m),
            faces=tile.surface.faces,
        )
    return tiles
