"""The map of a server, followed by an ordinary client."""

import time
from collections.abc import Mapping

from triquad_client import Client
from triquad_client.checks import Bounds
from triquad_client.mesh.followed_mesh import MeshTile, TileIndex
from triquad_client.mesh.mesh_watch import MeshWatch
from triquad_format.mapfile.metadata import utc_time

from triquad_tools.viewer.sources.map_source import MapState, TileSizes

_POINT = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
_PERIOD_S = 1.0  # between questions what changed: more often, and a robot's planner would notice


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

    def state(self) -> MapState:
        """Ask the server for its newest published state."""
        epoch = self.client.status().epoch
        return MapState(self.client.map_name, epoch, utc_time(time.time_ns()))

    def follow(self, level: int, bounds: Bounds | None = None) -> "LiveFollower":
        """Follow the mesh tiles of a level that meet ``bounds``, as the server makes them."""
        return LiveFollower(self.client, self.client.watch_mesh(bounds, level))


class LiveFollower:
    """Mesh tiles of a server within a box."""

    def __init__(self, client: Client, watch: MeshWatch) -> None:
        self._client = client
        self._watch = watch
        self._due_s = 0.0  # monotonic

    @property
    def tiles(self) -> Mapping[TileIndex, MeshTile]:
        """The tiles as of the last refresh, by their indices."""
        return self._watch.tiles

    @property
    def complete(self) -> bool:
        """Whether the last refresh left nothing pending."""
        return self._watch.complete

    def refresh(self) -> None:
        """Fetch one reply; once all was complete, no more than one a second."""
        now_s = time.monotonic()
        if now_s >= self._due_s:
            self._watch.next(timeout_s=0.0)
            self._due_s = now_s + _PERIOD_S if self._due_s or self._watch.complete else 0.0

    def moved(self, bounds: Bounds) -> "LiveFollower":
        """Follow another box instead."""
        known = self._watch.known_tiles()
        self.close()
        watch = self._client.watch_mesh(bounds, self._watch.level, known=known)
        return LiveFollower(self._client, watch)

    def close(self) -> None:
        """Stop following."""
        self._watch.close()
