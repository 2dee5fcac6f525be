"""What each request gets: from its message to the answer's message."""

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from triquad_format.errors import RefusedError
from triquad_format.wire.codec import Message
from triquad_format.wire.messages import (
    Tile,
    TileList,
    TileListRequest,
    TileRequest,
)

from triquad_server.epochs.history import EpochHistory
from triquad_server.mesh.epoch_mesh import EpochMesh
from triquad_server.mesh.tile_cache import TileShelf
from triquad_server.mesh.tile_lattice import LEVELS
from triquad_server.net.handlers import Handler
from triquad_server.net.request import Request
from triquad_server.settings import MeshSettings

TILE_INDEX_LIMIT = 1_000_000
"""Tile indices lie in ``[-TILE_INDEX_LIMIT, TILE_INDEX_LIMIT]``."""

MAX_TILES = 1_000_000
"""Tiles of one list."""

RequestT = TypeVar("RequestT", bound=Message)


def answering(kind: type[RequestT], answer: Callable[[RequestT], Message]) -> Handler:
    """A handler that decodes a ``kind`` and replies with what ``answer`` makes of it."""

    def handle(request: Request) -> None:
        request.answer(answer(request.read(kind)))

    return handle


class TileQueries:
    """Answers mesh queries."""

    def __init__(self, epochs: EpochHistory, shelf: TileShelf, settings: MeshSettings) -> None:
        """``shelf`` knows when tiles changed."""
        self._epochs = epochs
        self._settings = settings
        self._shelf = shelf

    def tiles(self, request: TileListRequest) -> TileList:
        """The tiles that meet the request's box."""
        check_box(request.minimum, request.maximum)
        check_level(request.level)
        epoch = self._epochs.get(request.epoch)
        mesh = EpochMesh(epoch, self._settings)
        tiles = mesh.tiles(request.minimum, request.maximum, request.level)
        if len(tiles) > MAX_TILES:
            raise RefusedError("too_large", f"{len(tiles)} tiles: ask for a smaller box")
        side_m = self._shelf.lattice(request.level).tile_side_m
        self._shelf.look(epoch)
        changed = np.minimum(self._shelf.changed(request.level, tiles), epoch.number)
        return TileList(epoch.number, side_m, tiles, changed)

    def tile(self, request: TileRequest) -> Tile:
        """The mesh of one tile."""
        index = (request.x, request.y, request.z)
        if max(map(abs, index)) > TILE_INDEX_LIMIT:
            raise RefusedError(
                "bad_request",
                f"tile {index} is out of range: use -{TILE_INDEX_LIMIT} to {TILE_INDEX_LIMIT}",
            )
        check_level(request.level)
        epoch = self._epochs.get(request.epoch)
        mesh = EpochMesh(epoch, self._settings).tile(index, request.level)
        # What nobody looked for yet shows in a later list: the tile is fetched once more then.
        (changed,) = self._shelf.changed(request.level, np.array([index])).tolist()
        return Tile(
            epoch.number, min(changed, epoch.number), mesh.origin, mesh.vertices, mesh.faces
        )


def check_level(level: int) -> None:
    """Refuse a level of detail that there is not."""
    if not 0 <= level < LEVELS:
        raise RefusedError("bad_request", f"level = {level} is out of range: use 0 to {LEVELS - 1}")


def check_box(minimum: NDArray[np.float64], maximum: NDArray[np.float64]) -> None:
    """Refuse a box [3], [3] with NaN or with corners the wrong way round; infinite is allowed."""
    if np.isnan([minimum, maximum]).any() or (minimum > maximum).any():
        raise RefusedError(
            "bad_request",
            f"not a box: minimum {minimum}, maximum {maximum}",
        )
