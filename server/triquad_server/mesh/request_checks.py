"""What requests about mesh tiles may ask for."""

import math

import numpy as np
from numpy.typing import NDArray
from triquad_format.errors import FormatError, RefusedError
from triquad_format.wire import keys
from triquad_format.wire.limits import LEVELS, MAX_KNOWN_TILES
from triquad_format.wire.messages import TileUpdatesRequest

from triquad_server.mesh.mesher import TileIndex

TILE_INDEX_LIMIT = 1_000_000
"""Tile indices lie in ``[-TILE_INDEX_LIMIT, TILE_INDEX_LIMIT]``."""


def check_level(level: int) -> None:
    """Refuse a level of detail that there is not."""
    if not 0 <= level < LEVELS:
        raise RefusedError("bad_request", f"level = {level} is out of range: use 0 to {LEVELS - 1}")


def check_box(minimum: NDArray[np.float64], maximum: NDArray[np.float64]) -> None:
    """Refuse a box [3], [3] with NaN or with corners the wrong way round; infinite is allowed."""
    if np.isnan([minimum, maximum]).any() or (minimum > maximum).any():
        raise RefusedError("bad_request", f"not a box: minimum {minimum}, maximum {maximum}")


def check_index(index: TileIndex) -> None:
    """Refuse a tile that is too far away."""
    if max(map(abs, index)) > TILE_INDEX_LIMIT:
        raise RefusedError(
            "bad_request",
            f"tile {index} is out of range: use -{TILE_INDEX_LIMIT} to {TILE_INDEX_LIMIT}",
        )


def check_updates(asks: TileUpdatesRequest, server: str, revision: int) -> None:
    """Refuse a request for changes with a field out of range.

    ``server`` is the name that this server's replies carry, ``revision`` the newest of them.
    """
    check_box(asks.minimum, asks.maximum)
    check_level(asks.level)
    try:
        keys.check_name("client", asks.client)
    except FormatError as error:
        raise RefusedError("bad_request", str(error)) from error
    # Written so that NaN is refused as well.
    if not 0 <= asks.timeout_s < math.inf:
        raise RefusedError(
            "bad_request", f"timeout_s = {asks.timeout_s} is not a time: use 0 or more"
        )
    if asks.max_bytes < 1 or asks.max_bytes_per_s < 0:
        raise RefusedError(
            "bad_request",
            f"max_bytes = {asks.max_bytes}, max_bytes_per_s = {asks.max_bytes_per_s}: "
            "use at least 1, and at least 0",
        )
    _check_held(asks)
    newest = revision if asks.server == server else 0
    if asks.server in ("", server) and not 0 <= asks.revision <= newest:
        raise RefusedError(
            "bad_request",
            f"revision = {asks.revision} was never given by server {asks.server!r}: "
            "use that of the reply before, or 0",
        )


def _check_held(asks: TileUpdatesRequest) -> None:
    if len(asks.held) != len(asks.held_versions):
        raise RefusedError(
            "bad_request", f"{len(asks.held_versions)} versions of {len(asks.held)} held tiles"
        )
    if len(asks.held) > MAX_KNOWN_TILES:
        raise RefusedError(
            "too_large", f"{len(asks.held)} held tiles exceed the limit of {MAX_KNOWN_TILES}"
        )
