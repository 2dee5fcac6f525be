"""The wire messages about the mesh; see :mod:`triquad_format.wire.messages`."""

from dataclasses import dataclass
from typing import Annotated

from triquad_format.wire.codec import MAX_MESSAGE_BYTES, Message
from triquad_format.wire.limits import MAX_CELL_M, MAX_TILE_M, MIN_LENGTH_M, TILE_INDEX_LIMIT
from triquad_format.wire.messages import (
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


@dataclass(frozen=True)
class MeshRequest(Message):
    """The mesh of some tiles."""

    tiles: TileIndices  # [T, 3], 1 to MAX_TILES_ASKED
    epoch: int  # 0: as they are followed, each made when its surface last changed
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
    filled: Annotated[StatusCodes, within(0, 1)] | None
    # [T] the epoch of which each tile is
    versions: Annotated[Epochs, asked_by("tiles")]


@dataclass(frozen=True)
class TileChangesRequest(Message):
    """Ask in which mesh tiles of a box the surface changed since an epoch of a server."""

    minimum: Point
    maximum: Point  # of the box, map frame; an open side is infinite
    level: int  # of detail
    server: str  # of the reply before, whose epoch is ``since``; empty at first
    since: int  # every tile of the box is known as of this epoch; 0: none is


@dataclass(frozen=True)
class TileChanges(Message):
    """Answer to :class:`TileChangesRequest`."""

    server: Name
    epoch: Epoch  # up to which the changes are known, for the next request
    is_newest: bool  # that is the newest epoch
    tile_side_m: Annotated[float, within(MIN_LENGTH_M, MAX_TILE_M)]
    cell_m: Annotated[float, within(MIN_LENGTH_M, MAX_CELL_M)]
    # [T, 3] that changed after ``since``; where that is 0, or of another server, all that may have
    # faces
    tiles: Annotated[TileIndices, _IN_RANGE]
    # [T] the surface of each last changed in this epoch
    changed: Annotated[Epochs, rows_of("tiles")]
