"""The map of a server, followed by an ordinary client."""

from triquad_client import Client
from triquad_client.checks import Bounds
from triquad_client.mesh.mesh_watch import MeshWatch

from triquad_tools.viewer.sources.map_source import TileFollower, TileSizes

_POINT = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


class LiveSource:
    """The map of a server; the caller closes the client."""

    grows = True

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

    def follow(
        self, level: int, bounds: Bounds | None = None, before: TileFollower | None = None
    ) -> MeshWatch:
        """Follow the mesh tiles of a level that meet ``bounds``, as the server makes them."""
        known = before.known_tiles() if isinstance(before, MeshWatch) else None
        return self.client.watch_mesh(bounds, level, known=known)
