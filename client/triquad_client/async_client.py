"""The client for programs with an event loop: the blocking one, each of its calls in a thread."""

from __future__ import annotations

from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

from triquad_client.calls.queries import MapQueries, PinnedMap
from triquad_client.checks import Bounds
from triquad_client.client import MAX_DOWNLOAD_BYTES, Client
from triquad_client.mesh.followed_mesh import FollowedMesh, KnownTiles, MeshUpdate
from triquad_client.mesh.mesh_watch import MeshWatch, WatchedTiles
from triquad_client.net.connection import Connection
from triquad_client.net.in_threads import InThreads, Threads, awaited, in_thread
from triquad_client.net.opening import open_connection
from triquad_client.offline.synced_map import SyncedMap, SyncReport


class AsyncMapQueries(InThreads):
    """Asks about the map: :class:`MapQueries` to be awaited."""

    query_sdf = awaited(MapQueries.query_sdf)
    query_distance = awaited(MapQueries.query_distance)
    query_spheres = awaited(MapQueries.query_spheres)
    query_segments = awaited(MapQueries.query_segments)
    query_polyline = awaited(MapQueries.query_polyline)
    query_rays = awaited(MapQueries.query_rays)
    query_ground = awaited(MapQueries.query_ground)
    query_grid = awaited(MapQueries.query_grid)
    align = awaited(MapQueries.align)


class AsyncPinnedMap(AsyncMapQueries):
    """The map as it was in one epoch: :class:`PinnedMap` to be awaited."""

    def __init__(self, pinned: PinnedMap, threads: Threads) -> None:
        """Use ``AsyncClient.pinned``."""
        super().__init__(pinned, threads)
        self.epoch = pinned.epoch


class AsyncSyncedMap(AsyncMapQueries):
    """A copy of the part of a map that a box needs: :class:`SyncedMap` to be awaited."""

    _blocking: SyncedMap

    refresh = awaited(SyncedMap.refresh)

    @property
    def epoch(self) -> int:
        """As :attr:`SyncedMap.epoch`."""
        return self._blocking.epoch

    @property
    def age_s(self) -> float:
        """As :attr:`SyncedMap.age_s`."""
        return self._blocking.age_s

    @property
    def report(self) -> SyncReport:
        """As :attr:`SyncedMap.report`."""
        return self._blocking.report


class AsyncMeshWatch(InThreads, WatchedTiles):
    """The mesh tiles of a box, kept up to date by :meth:`next`; nothing is asked in between.

    It is :class:`MeshWatch` to be awaited: use it in ``async with``, and ``async for``. Where the
    client is closed, what is awaited raises :class:`ClosedError`. Several tasks may use it: each
    change is reported to one of them. A cancelled task may take a change with it, which then
    is in :attr:`tiles` without having been reported; a ``timeout_s`` does not.
    """

    _blocking: MeshWatch

    next = awaited(MeshWatch.next)
    catch_up = awaited(MeshWatch.catch_up)
    mesh = awaited(MeshWatch.mesh)

    async def __aenter__(self) -> AsyncMeshWatch:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    def __aiter__(self) -> AsyncMeshWatch:
        """Yield updates as they come, until the watch is closed."""
        return self

    async def __anext__(self) -> MeshUpdate:
        update = await self.next()
        if update is None:
            raise StopAsyncIteration
        return update

    async def close(self) -> None:
        """End: :meth:`next` returns ``None``, and iteration ends, also in other tasks."""
        self._blocking.close()

    def _now(self) -> FollowedMesh:
        return self._blocking._now()


class AsyncClient(AsyncMapQueries):
    """A connection to one map of a server, for one event loop: :class:`Client` to be awaited.

    Scans go out in the order of the calls of :meth:`publish_scan`. :meth:`watch_mesh` itself is
    not awaited, but what its watch does is. Any number of calls may be awaited at the same time.
    Where the task of a call is cancelled, so are its requests; where the client is closed, they
    raise :class:`ClosedError`.
    """

    _blocking: Client

    publish_scan = awaited(Client.publish_scan)
    publish_depth = awaited(Client.publish_depth)
    restart_source = awaited(Client.restart_source)
    flush = awaited(Client.flush)
    settle = awaited(Client.settle)
    changes = awaited(Client.changes)
    sources = awaited(Client.sources)
    mesh = awaited(Client.mesh)
    status = awaited(Client.status)
    metrics = awaited(Client.metrics)
    checkpoint = awaited(Client.checkpoint)
    reset = awaited(Client.reset)
    correct_poses = awaited(Client.correct_poses)
    download_map = awaited(Client.download_map)
    maps = awaited(Client.maps)
    create_map = awaited(Client.create_map)
    drop_map = awaited(Client.drop_map)

    @property
    def map_name(self) -> str:
        """The map this client works with."""
        return self._blocking.map_name

    async def close(self) -> None:
        """End the connection. Scans that were published may still be on their way: flush first."""
        await in_thread(self._blocking.close)

    async def pinned(self) -> AsyncPinnedMap:
        """Return the map as it is now, for queries that belong together."""
        pinned = await self._threads.run("pinned", self._blocking.pinned)
        return AsyncPinnedMap(pinned, self._threads)

    def watch_mesh(
        self,
        bounds: Bounds | None = None,
        level: int = 0,
        max_bytes_per_s: int | None = None,
        known: KnownTiles | None = None,
    ) -> AsyncMeshWatch:
        """Follow the mesh tiles that meet ``bounds``, as :meth:`Client.watch_mesh` does."""
        watch = self._blocking.watch_mesh(bounds, level, max_bytes_per_s, known)
        return AsyncMeshWatch(watch, self._threads)

    async def sync(
        self, bounds: Bounds, path: str | Path, accept_emptier: bool = False
    ) -> AsyncSyncedMap:
        """Keep a copy of what the map needs to answer within ``bounds``: :meth:`Client.sync`."""
        synced = await self._threads.run(
            "sync", lambda: self._blocking.sync(bounds, path, accept_emptier)
        )
        return AsyncSyncedMap(synced, Threads())  # its own: it need not wait for the link


class Connecting:
    """A client that is being connected: await it, or use it in an ``async with`` statement."""

    def __init__(self, open_: Callable[[], Connection]) -> None:
        """Use :func:`connect_async`."""
        self._open = open_

    def __await__(self) -> Generator[Any, None, AsyncClient]:
        return self._connect().__await__()

    async def __aenter__(self) -> AsyncClient:
        self._client = await self
        return self._client

    async def __aexit__(self, *_: object) -> None:
        await self._client.close()

    async def _connect(self) -> AsyncClient:
        # A connection that comes after its task was cancelled is closed, as nobody has it.
        return AsyncClient(Client(await in_thread(self._open)), Threads())


def connect_async(
    endpoint: str | None = None,
    map: str = "default",  # noqa: A002 - the word of the command line and of the documentation
    *,
    timeout_s: float | None = None,
    config: str | Path | None = None,
    max_download_bytes: int = MAX_DOWNLOAD_BYTES,
    coordinates: str = "map",
) -> Connecting:
    """Connect to a map server: ``async with connect_async(...) as client``, or await it and close.

    Arguments and errors are those of :func:`connect`.
    """
    return Connecting(
        lambda: open_connection(
            endpoint,
            map,
            timeout_s,
            config,
            max_download_bytes=max_download_bytes,
            coordinates=coordinates,
        )
    )
