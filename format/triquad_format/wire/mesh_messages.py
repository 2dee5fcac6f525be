"""The wire messages about the mesh; see :mod:`triquad_format.wire.messages`."""

from dataclasses import dataclass
from typing import Annotated

from triquad_format.wire import keys
from triquad_format.wire.bounds import asked_by, parts_of, rows, rows_of, within
from triquad_format.wire.codec import MAX_MESSAGE_BYTES, Message, Request
from triquad_format.wire.limits import (
    LEVELS,
    MAX_CELL_M,
    MAX_FILL_M,
    MAX_TILE_M,
    MAX_TILES_ASKED,
    MIN_LENGTH_M,
    TILE_INDEX_LIMIT,
)
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
    UpperCorner,
)

_IN_RANGE = within(-TILE_INDEX_LIMIT, TILE_INDEX_LIMIT)
Level = Annotated[int, within(0, LEVELS - 1)]  # of detail
FillLength = Annotated[float, within(0, MAX_FILL_M)]


@dataclass(frozen=True)
class TileList(MapReply):
    """Answer to :class:`TileListRequest`."""

    tile_side_m: Annotated[float, within(MIN_LENGTH_M, MAX_TILE_M)]
    # [T, 3]: tile t covers origin + [t, t + 1) * tile_side_m
    tiles: Annotated[TileIndices, _IN_RANGE]
    origin: Annotated[Point, within()] | None = None  # metres, map frame; None: 0 0 0


@dataclass(frozen=True)
class TileListRequest(Request[TileList], operation=keys.TILE_LIST, background=True):
    """Ask which mesh tiles meet a box of the map frame; an open side is infinite."""

    minimum: Point
    maximum: UpperCorner
    epoch: int
    level: Level = 0  # of detail: cells are 2**level times as large as those of level 0
    fill_m: FillLength = 0.0  # tiles with surface that is continued up to so far, too


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
class MeshRequest(Request[MeshReply], operation=keys.MESH, background=True):
    """The mesh of some tiles."""

    tiles: Annotated[TileIndices, _IN_RANGE, rows(1, MAX_TILES_ASKED)]  # [T, 3]
    epoch: int  # 0: as they are followed, each made when its surface last changed
    level: Level = 0
    fill_m: FillLength = 0.0  # how far from seen surface it is continued into unknown space; 0: not


@dataclass(frozen=True)
class TileChanges(Message):
    """Answer to :class:`TileChangesRequest`."""

    server: Name
    epoch: Epoch  # up to which the changes are known
    revision: Count  # number of the newest change of the level, for the next request
    is_newest: bool  # that is the newest epoch
    tile_side_m: Annotated[float, within(MIN_LENGTH_M, MAX_TILE_M)]
    cell_m: Annotated[float, within(MIN_LENGTH_M, MAX_CELL_M)]
    # [T, 3] that changed after ``since``; where that is 0, or of another server, all that may have
    # faces
    tiles: Annotated[TileIndices, _IN_RANGE]
    # [T] the surface of each last changed in this epoch
    changed: Annotated[Epochs, rows_of("tiles")]
    origin: Annotated[Point, within()] | None = None  # from where tiles count, as in TileList


@dataclass(frozen=True)
class TileChangesRequest(Request[TileChanges], operation=keys.TILE_CHANGES, background=True):
    """Ask in which mesh tiles of a box the surface changed since a revision of a server."""

    minimum: Point
    maximum: UpperCorner  # of the box, map frame; an open side is infinite
    level: Level
    server: str  # of the reply before, whose revision is ``since``; empty at first
    since: int  # every tile of the box is known as of this revision; 0: none is
