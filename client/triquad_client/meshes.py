"""Fetching mesh tiles, and whole meshes from them."""

import numpy as np
from numpy.typing import NDArray
from triquad_format import keys
from triquad_format.messages import Tile, TileList, TileListRequest, TileRequest

from triquad_client.connection import Connection, Pending, in_flight, retried
from triquad_client.mesh import Mesh
from triquad_client.welding import joined


class Meshes:
    """Mesh requests; they go in the background of everything else."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def tiles(self, minimum: NDArray[np.float64], maximum: NDArray[np.float64]) -> TileList:
        """The tiles that meet the box between two corners [3]."""
        request = TileListRequest(minimum, maximum, 0)
        return self._connection.ask(keys.TILE_LIST, request, TileList, background=True)

    def tile(self, x: int, y: int, z: int) -> Mesh:
        """The newest mesh of one tile."""
        tile = self._send((x, y, z), 0).result()
        return Mesh(tile.origin + tile.vertices.astype(np.float64), tile.faces, tile.epoch)

    def mesh(self, minimum: NDArray[np.float64], maximum: NDArray[np.float64]) -> Mesh:
        """The faces whose centroids lie in the box between two corners [3], from one epoch."""
        return retried("epoch_gone", lambda: self._mesh(minimum, maximum))

    def _mesh(self, minimum: NDArray[np.float64], maximum: NDArray[np.float64]) -> Mesh:
        listed = self.tiles(minimum, maximum)
        indices = [(int(x), int(y), int(z)) for x, y, z in listed.tiles]
        tiles = in_flight(lambda index: self._send(index, listed.epoch), indices)
        triangles = [(tile.origin + tile.vertices, tile.faces) for tile in tiles]
        return Mesh(*joined(triangles, listed.tile_side_m, minimum, maximum), listed.epoch)

    def _send(self, index: tuple[int, int, int], epoch: int) -> Pending[Tile]:
        request = TileRequest(*index, epoch)
        return self._connection.send(keys.TILE, request, Tile, background=True)
