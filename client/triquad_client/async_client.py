"""The client for programs with an event loop."""

from pathlib import Path

from numpy.typing import ArrayLike
from triquad_format.mapfile.writer import MapFileInfo
from triquad_format.wire.messages import (
    CheckpointInfo,
    MapInfo,
    ResetReply,
    ServerStatus,
    TileList,
)
from triquad_format.wire.metrics_messages import ServerMetrics

from triquad_client.calls import admin, changes, download, questions, sources
from triquad_client.calls.async_queries import AsyncMapQueries, AsyncPinnedMap
from triquad_client.calls.changes import ChangeReport
from triquad_client.calls.scans import FlushReport, ScanPublisher
from triquad_client.calls.sources import SourceReport
from triquad_client.checks import Bounds, PoseLike
from triquad_client.client import Client
from triquad_client.depth_image import Intrinsics, depth_points
from triquad_client.documentation import documented_as
from triquad_client.mesh.async_mesh_watch import AsyncMeshWatch
from triquad_client.mesh.followed_mesh import FollowedMesh, KnownTiles
from triquad_client.mesh.mesh import Mesh
from triquad_client.mesh.mesh_calls import fetch_mesh, fetch_tile, fetch_tiles
from triquad_client.net.async_driver import AsyncDriver
from triquad_client.net.connection import Connection
from triquad_client.offline.synced_map import AsyncSyncedMap


@documented_as(Client)
class AsyncClient(AsyncMapQueries):
    """A connection to one map of a server, for one event loop: :class:`Client` to be awaited.

    Scans go out in the order of the calls of :meth:`publish_scan`. :meth:`watch_mesh` itself is
    not awaited, but what its watch does is. Any number of calls may be awaited at the same time.
    Where the task of a call is cancelled, so are its requests; where the client is closed, they
    raise :class:`ClosedError`.
    """

    def __init__(self, connection: Connection, driver: AsyncDriver) -> None:
        """Use :func:`connect_async`."""
        self._connection = connection
        self._driver = driver
        self._scans = ScanPublisher(connection)
        super().__init__(driver.run_call)

    @property
    def map_name(self) -> str:
        """The map this client works with."""
        return self._connection.map_name

    async def close(self) -> None:
        await self._driver.close()

    async def publish_scan(
        self,
        points: ArrayLike,
        world_from_sensor: PoseLike,
        stamp_s: float | None = None,
        source: str = "default",
        no_return: ArrayLike | None = None,
    ) -> None:
        await self._driver.in_order(
            lambda: self._scans.publish(
                points, world_from_sensor, stamp_s, source=source, no_return=no_return
            )
        )

    async def publish_depth(
        self,
        depth: ArrayLike,
        intrinsics: Intrinsics,
        world_from_camera: PoseLike,
        stamp_s: float | None = None,
        source: str = "default",
        stride: int = 1,
    ) -> None:
        await self._driver.in_order(
            lambda: self._scans.publish(
                depth_points(depth, intrinsics, stride),
                world_from_camera,
                stamp_s,
                source=source,
                no_return=None,
            )
        )

    async def restart_source(self, source: str = "default") -> None:
        await self._driver.in_order(lambda: self._scans.restart(source))

    async def flush(self, timeout_s: float = 30.0, pending: int = 0) -> FlushReport:
        return await self._run(self._scans.flush(timeout_s, pending))

    async def settle(self, timeout_s: float = 600.0) -> ServerStatus:
        return await self._run(self._scans.settle(timeout_s))

    async def pinned(self) -> AsyncPinnedMap:
        return AsyncPinnedMap(self._run, await self._run(questions.pin_newest()))

    async def changes(
        self, since: int | ChangeReport | None = None, bounds: Bounds | None = None
    ) -> ChangeReport:
        return await self._run(changes.changes(since, bounds))

    async def sources(
        self, since: SourceReport | None = None, max_points: int = 5_000
    ) -> SourceReport:
        return await self._run(sources.sources(since, max_points))

    async def tiles(self, bounds: Bounds | None = None, level: int = 0) -> TileList:
        return await self._run(fetch_tiles(bounds, level))

    async def mesh_tile(self, x: int, y: int, z: int, level: int = 0) -> Mesh:
        limit = self._connection.max_download_bytes
        return await self._run(fetch_tile((x, y, z), level, limit))

    async def mesh(self, bounds: Bounds | None = None, level: int = 0, fill_m: float = 0.0) -> Mesh:
        limit = self._connection.max_download_bytes
        return await self._run(fetch_mesh(bounds, level, limit, fill_m))

    def watch_mesh(
        self,
        bounds: Bounds | None = None,
        level: int = 0,
        max_bytes_per_s: int | None = None,
        known: KnownTiles | None = None,
    ) -> AsyncMeshWatch:
        followed = FollowedMesh.initial(
            bounds,
            level,
            max_bytes_per_s=max_bytes_per_s,
            known=known,
            max_bytes=self._connection.max_download_bytes,
        )
        return AsyncMeshWatch(self._run, followed)

    async def status(self) -> ServerStatus:
        return await self._run(admin.status())

    async def metrics(self) -> ServerMetrics:
        return await self._run(admin.metrics())

    async def checkpoint(self) -> CheckpointInfo:
        return await self._run(admin.checkpoint())

    async def reset(self, bounds: Bounds | None = None) -> ResetReply:
        return await self._run(admin.reset(bounds))

    async def download_map(self, path: str | Path, training: bool = False) -> MapInfo:
        return await self._run(
            download.fetch(Path(path), training, self._connection.max_download_bytes)
        )

    async def download_box(self, path: str | Path, bounds: Bounds) -> MapFileInfo:
        return await self._run(
            download.fetch_box(Path(path), bounds, self._connection.max_download_bytes)
        )

    async def sync(
        self, bounds: Bounds, path: str | Path, accept_emptier: bool = False
    ) -> AsyncSyncedMap:
        synced = AsyncSyncedMap(Path(path), bounds, self._run, self._connection.max_download_bytes)
        await synced.refresh(accept_emptier)
        return synced

    async def maps(self) -> list[str]:
        return await self._driver.maps()
