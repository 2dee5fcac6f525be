"""The mesh of a whole map: the server's tiles, welded as the client welds them."""

import numpy as np
from triquad_client.mesh.mesh import Mesh
from triquad_client.mesh.welding import Triangles, joined
from triquad_server.epochs.epoch import Epoch

from triquad_tools.console.errors import ToolError
from triquad_tools.console.progress import Report
from triquad_tools.mapfiles.source import Box

MAX_FACES = 50_000_000

_EVERYWHERE = np.array([[-np.inf] * 3, [np.inf] * 3])


def surface_mesh(epoch: Epoch, box: Box | None, tile_side_m: float, report: Report) -> Mesh:
    """The surface where rays have seen one: faces whose centroids lie in the box, if one is given.

    Raises:
        ToolError: there are too many faces.
    """
    low, high = _EVERYWHERE if box is None else box
    tiles: list[Triangles] = []
    faces = 0
    indices = epoch.tiles(low, high).tolist()
    for number, (x, y, z) in enumerate(indices):
        tile = epoch.mesh((x, y, z))
        tiles.append((tile.origin + tile.vertices, tile.faces))
        faces += len(tile.faces)
        if faces > MAX_FACES:
            raise ToolError(f"the mesh has more than {MAX_FACES:,} faces: use --crop or --cell")
        report((number + 1) / len(indices), f"{faces:,} faces")
    return Mesh(*joined(tiles, tile_side_m, low, high), epoch.number)
