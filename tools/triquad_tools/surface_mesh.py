"""The mesh of a whole map: the server's tiles, welded as the client welds them."""

import numpy as np
from numpy.typing import NDArray
from triquad_client.mesh import Mesh
from triquad_client.welding import compacted, welded
from triquad_server.epoch import Epoch
from triquad_server.mesher import TileMesh

from triquad_tools.errors import ToolError
from triquad_tools.map_source import Box
from triquad_tools.progress import Report

MAX_FACES = 50_000_000

_EVERYWHERE = np.array([[-np.inf] * 3, [np.inf] * 3])


def surface_mesh(epoch: Epoch, box: Box | None, tile_side_m: float, report: Report) -> Mesh:
    """The surface where rays have seen one: faces whose centroids lie in the box, if one is given.

    Raises:
        ToolError: there are too many faces.
    """
    low, high = _EVERYWHERE if box is None else box
    tiles: list[TileMesh] = []
    faces = 0
    indices = epoch.tiles(low, high).indices.tolist()
    for number, (x, y, z) in enumerate(indices):
        tiles.append(epoch.mesh((x, y, z)))
        faces += len(tiles[-1].faces)
        if faces > MAX_FACES:
            raise ToolError(f"the mesh has more than {MAX_FACES:,} faces: use --crop or --cell")
        report((number + 1) / len(indices), f"{faces:,} faces")
    return _within(low, high, *welded(*_joined(tiles), tile_side_m), epoch.number)


def _joined(tiles: list[TileMesh]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Vertices [V, 3] in the map frame and faces [F, 3] of all tiles."""
    starts = np.cumsum([0, *(len(tile.vertices) for tile in tiles)])
    vertices = [np.zeros((0, 3)), *(tile.origin + tile.vertices for tile in tiles)]
    faces = [np.zeros((0, 3), np.int32)]
    faces += [tile.faces + int(start) for start, tile in zip(starts, tiles, strict=False)]
    return np.concatenate(vertices), np.concatenate(faces).astype(np.int32)


def _within(
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    vertices: NDArray[np.float64],
    faces: NDArray[np.int32],
    epoch: int,
) -> Mesh:
    centroids = vertices[faces].mean(axis=1)
    inside = ((centroids >= low) & (centroids <= high)).all(axis=1)
    return Mesh(*compacted(vertices, faces[inside]), epoch)
