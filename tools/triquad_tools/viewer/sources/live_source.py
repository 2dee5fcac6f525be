"""The map of a server, followed by an ordinary client."""

import time
from collections.abc import Mapping

from triquad_client import Client
from triquad_client.checks import Bounds
from triquad_client.mesh.followed_mesh import KnownTiles, MeshTile, TileIndex
from triquad_client.mesh.mesh_watch import MeshWatch
from triquad_format.mapfile.metadata import utc_time

from triquad_tools.viewer.sources.map_source import MapState, TileSizes

_POINT = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
_PERIOD_S = 1.0  # between questions what changed: more often, and a robot's planner would notice


class LiveSource:
    """The map of a server; the client is closed by who opened it."""

    grows = True

    def __init__(self, client: Client, endpoint: str) -> None:
        """Ask the server for the lengths of its mesh.

        Raises:
            TriquadError: it does not answer.
        """
        self.client = client
        self.queries = client
        self.title = f"{client.map_name} at {endpoint}"
        with client.watch_mesh(_POINT) as watch:
            watch.catch_up()
            self.sizes = TileSizes(watch.cell_m, watch.tile_side_m)

    def state(self) -> MapState:
        """What the server has published last; it is asked."""
        now = utc_time(time.time_ns())
        return MapState(self.client.map_name, self.client.status().epoch, now)

    def follow(self, level: int, bounds: Bounds | None = None) -> "LiveFollower":
        """The mesh tiles of a level that meet ``bounds``, as the server makes them."""
        return LiveFollower(self.client, level, bounds)


class LiveFollower:
    """Mesh tiles of a server within a box."""

    def __init__(
        self,
        client: Client,
        level: int,
        bounds: Bounds | None,
        known: KnownTiles | None = None,
    ) -> None:
        self._client = client
        self._loaded = False  # all was there once: from then on only changes come
        self._due_s = 0.0  # monotonic
        self._watch: MeshWatch = client.watch_mesh(bounds, level, known=known)

    @property
    def tiles(self) -> Mapping[TileIndex, MeshTile]:
        """The tiles as of the last refresh, by their indices."""
        return self._watch.tiles

    @property
    def complete(self) -> bool:
        """Whether the last refresh left nothing waiting."""
        return self._watch.complete

    def refresh(self) -> None:
        """Fetch what one reply brings; once all was there, no more than one a second."""
        now_s = time.monotonic()
        if self._loaded and now_s < self._due_s:
            return
        self._due_s = now_s + _PERIOD_S
        self._watch.next(timeout_s=0.0)
        self._loaded |= self._watch.complete

    def moved(self, bounds: Bounds) -> "LiveFollower":
        """Follow another box instead."""
        known = self._watch.known_tiles()
        self.close()
        return LiveFollower(self._client, self._watch.level, bounds, known=known)

    def close(self) -> None:
        """Follow no longer."""
        self._watch.close()
