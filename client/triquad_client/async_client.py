"""The client for programs with an event loop."""

from pathlib import Path

from triquad_client.calls import questions
from triquad_client.calls.operations import ClientOperations
from triquad_client.calls.queries import AsyncMapQueries, AsyncPinnedMap
from triquad_client.checks import Bounds
from triquad_client.client import Client
from triquad_client.documentation import documented_as
from triquad_client.mesh.async_mesh_watch import AsyncMeshWatch
from triquad_client.mesh.followed_mesh import KnownTiles
from triquad_client.net.async_driver import AsyncDriver
from triquad_client.net.connection import Connection
from triquad_client.offline.synced_map import AsyncSyncedMap


@documented_as(Client)
class AsyncClient(ClientOperations, AsyncMapQueries):
    """A connection to one map of a server, for one event loop: :class:`Client` to be awaited.

    Scans go out in the order of the calls of :meth:`publish_scan`. :meth:`watch_mesh` itself is
    not awaited, but what its watch does is. Any number of calls may be awaited at the same time.
    Where the task of a call is cancelled, so are its requests; where the client is closed, they
    raise :class:`ClosedError`.
    """

    def __init__(self, connection: Connection, driver: AsyncDriver) -> None:
        """Use :func:`connect_async`."""
        ClientOperations.__init__(self, connection)
        self._driver = driver
        AsyncMapQueries.__init__(self, driver.run_call)

    async def close(self) -> None:
        await self._driver.close()

    async def pinned(self) -> AsyncPinnedMap:
        return AsyncPinnedMap(self._run, await self._run(questions.pin_newest()))

    def watch_mesh(
        self,
        bounds: Bounds | None = None,
        level: int = 0,
        max_bytes_per_s: int | None = None,
        known: KnownTiles | None = None,
    ) -> AsyncMeshWatch:
        followed = self._followed(bounds, level, max_bytes_per_s, known)
        return AsyncMeshWatch(self._run, followed)

    async def sync(
        self, bounds: Bounds, path: str | Path, accept_emptier: bool = False
    ) -> AsyncSyncedMap:
        synced = AsyncSyncedMap(Path(path), bounds, self._run, self._connection.max_download_bytes)
        await synced.refresh(accept_emptier)
        return synced

    async def maps(self) -> list[str]:
        return await self._driver.maps()
