"""The map of a server, followed by an ordinary client."""

from triquad_client import Client
from triquad_client.checks import Bounds
from triquad_client.mesh.mesh_watch import MeshWatch

from triquad_tools.viewer.sources.tile_sizes import TileSizes

_POINT = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


class LiveSource:
    """The map of a server; the caller closes the client."""

    grows = True
    """More of it may become known while it is shown."""

    def __init__(self, client: Client, endpoint: str) -> None:
        """Ask the server for the lengths of its mesh.

        Raises:
            TriquadError: it does not answer.
        """
        self.client = self.queries = client
        self.title = f"{client.map_name} at {endpoint}"
        with client.watch_mesh(_POINT) as watch:
            watch.catch_up()
            self.sizes = TileSizes(watch.cell_m, watch.tile_side_m)

    def follow(self, level: int, bounds: Bounds | None = None, before: object = None) -> MeshWatch:
        """Follow the mesh tiles of a level that meet ``bounds``, as the server makes them.

        Those of a follower ``before``, of the same level, are not fetched again.
        """
        known = before.known_tiles() if isinstance(before, MeshWatch) else None
        return self.client.watch_mesh(bounds, level, known=known)
