"""The wire messages about the mesh; see :mod:`triquad_format.wire.messages`."""

from dataclasses import dataclass
from typing import Annotated

from triquad_format.wire.codec import MAX_MESSAGE_BYTES, Message
from triquad_format.wire.limits import MAX_CELL_M, MAX_TILE_M, MIN_LENGTH_M, TILE_INDEX_LIMIT
from triquad_format.wire.messages import (
    Count,
    Epoch,
    Epochs,
    Integers,
    MapReply,
    Name,
    Point,
    StatusCodes,
    TileIndices,
)
from triquad_format.wire.reply import asked_by, parts_of, rows_of, within

_IN_RANGE = within(-TILE_INDEX_LIMIT, TILE_INDEX_LIMIT)


@dataclass(frozen=True)
class TileListRequest(Message):
    """Ask which mesh tiles meet a box of the map frame; an open side is infinite."""

    minimum: Point
    maximum: Point
    epoch: int
    level: int = 0  # of detail: cells are 2**level times as large as those of level 0
    fill_m: float = 0.0  # tiles with surface that is continued up to so far, too


@dataclass(frozen=True)
class TileList(MapReply):
    """Answer to :class:`TileListRequest`."""

    tile_side_m: Annotated[float, within(MIN_LENGTH_M, MAX_TILE_M)]
    # [T, 3]: tile t covers [t, t + 1) * tile_side_m
    tiles: Annotated[TileIndices, _IN_RANGE]
    # [T] the surface of each tile last changed in this epoch
    changed: Annotated[Epochs, rows_of("tiles")]


@dataclass(frozen=True)
class MeshRequest(Message):
    """The mesh of some tiles."""

    tiles: TileIndices  # [T, 3], 1 to MAX_TILES_ASKED
    epoch: int
    level: int = 0  # of detail
    fill_m: float = 0.0  # how far from seen surface it is continued into unknown space; 0: not


@dataclass(frozen=True)
class MeshReply(MapReply):
    """Answer to :class:`MeshRequest`: the tiles as they were asked for, one behind the other."""

    tile_side_m: Annotated[float, within(MIN_LENGTH_M, MAX_TILE_M)]
    cell_m: Annotated[float, within(MIN_LENGTH_M, MAX_CELL_M)]
    # [T] bytes of each
    sizes: Annotated[Integers, within(0, MAX_MESSAGE_BYTES), asked_by("tiles"), parts_of("data")]
    data: bytes  # of all: triquad_format.wire.tile_codec
    # [F] of all faces, 1 where the surface was continued and no ray met it, else 0; None: was not
    # asked for
    filled: Annotated[StatusCodes, within(0, 1)] | None = None


@dataclass(frozen=True)
class TileUpdatesRequest(Message):
    """Ask which mesh tiles in a box changed; answered at once."""

    minimum: Point
    maximum: Point  # of the box, map frame; an open side is infinite
    level: int  # of detail
    server: str  # of the reply before, to which revision and known belong; empty at first
    revision: int  # of the reply before: everything up to it is known; 0 at first
    known: TileIndices  # [H, 3] tiles that are known whatever the revision
    known_versions: Integers  # [H]
    max_bytes: int  # of the reply's tiles; a single tile may have more


@dataclass(frozen=True)
class TileUpdates(Message):
    """Answer to :class:`TileUpdatesRequest`."""

    server: Name
    revision: Count  # for the next request
    epoch: Epoch  # the tiles show this epoch, where complete
    complete: bool  # nothing more is to come
    restart: bool  # the request spoke of another server: what was known of it is void
    tile_side_m: Annotated[float, within(MIN_LENGTH_M, MAX_TILE_M)]
    cell_m: Annotated[float, within(MIN_LENGTH_M, MAX_CELL_M)]
    tiles: Annotated[TileIndices, _IN_RANGE]  # [T, 3] that changed
    versions: Annotated[Epochs, rows_of("tiles")]  # [T] epoch of which each is
    # [T] bytes of each
    sizes: Annotated[Integers, within(0, MAX_MESSAGE_BYTES), rows_of("tiles"), parts_of("data")]
    data: bytes  # of all, one behind the other: triquad_format.wire.tile_codec
    removed: Annotated[TileIndices, _IN_RANGE]  # [R, 3] that have no faces any more
