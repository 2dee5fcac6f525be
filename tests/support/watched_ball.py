"""A ball that a server learns half by half, while its mesh is watched."""

import numpy as np
from support import servers
from triquad_client import AsyncMeshWatch, MeshWatch
from triquad_server.settings import MeshSettings

SETTINGS = servers.SMALL.model_copy(update={"mesh": MeshSettings(tile_cells=16, tolerance_m=0.1)})


def digests(watch: MeshWatch | AsyncMeshWatch) -> dict[tuple[int, int, int], int]:
    return {
        index: hash((tile.vertices.tobytes(), tile.faces.tobytes()))
        for index, tile in watch.tiles.items()
    }


def agree(*watches: MeshWatch) -> bool:
    """Let all catch up; return whether they hold the same bytes.

    To fit a tile that one of them fetches, another may be made again, of which the first ones are
    told when they ask next.
    """
    for watch in watches:
        watch.catch_up(servers.WAIT_S)
    return all(digests(watch) == digests(watches[0]) for watch in watches)


def half(side: int) -> np.ndarray:
    """The half of the ball at x > 0, or at x < 0."""
    points = servers.sphere(12_000)
    return points[np.sign(points[:, 0]) == side]
