"""Following the mesh of a box, in an event loop."""

import asyncio
from contextlib import suppress
from typing import Any

from triquad_client.documentation import documented_as
from triquad_client.mesh.followed_mesh import FollowedMesh, MeshUpdate
from triquad_client.mesh.mesh import Mesh
from triquad_client.mesh.mesh_watch import MeshWatch, WatchClosedError, WatchedMesh
from triquad_client.net.call import AsyncRun, Call, ResultT, offload
from triquad_client.net.operation import Awaited


@documented_as(MeshWatch)
class AsyncMeshWatch(WatchedMesh, Awaited):
    """The mesh tiles of a box, kept up to date by :meth:`next`; nothing is asked in between.

    It is :class:`MeshWatch` to be awaited: use it in ``async with``, and ``async for``. Where the
    client is closed, what is awaited raises :class:`ClosedError`. Several tasks may use it: each
    change is reported to one of them. A cancelled task may take a change with it, which then
    is in :attr:`tiles` without having been reported; a ``timeout_s`` does not. A thread joins the
    tiles to a mesh.
    """

    def __init__(self, run: AsyncRun, followed: FollowedMesh) -> None:
        """Use :meth:`AsyncClient.watch_mesh`."""
        super().__init__(followed)
        self._run_call = run
        self._closed: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    async def __aenter__(self) -> "AsyncMeshWatch":
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    def __aiter__(self) -> "AsyncMeshWatch":
        """Yield updates as they come, until the watch is closed."""
        return self

    async def __anext__(self) -> MeshUpdate:
        update = await self.next()
        if update is None:
            raise StopAsyncIteration
        return update

    async def next(self, timeout_s: float | None = None) -> MeshUpdate | None:
        with suppress(WatchClosedError):
            return await self._run(self._next(timeout_s))
        return None

    async def mesh(self) -> Mesh:
        followed = self._followed
        return await self._run_call(offload(lambda _: followed.mesh()))

    async def close(self) -> None:
        if not self._closed.done():
            self._closed.set_result(None)

    async def _run(self, call: Call[ResultT]) -> ResultT:
        asking = asyncio.ensure_future(self._run_call(call))
        either: set[asyncio.Future[Any]] = {asking, self._closed}
        try:
            await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
            if asking.done():
                return asking.result()
            raise WatchClosedError("the watch is closed")
        finally:
            asking.cancel()
            await asyncio.wait({asking})  # until its requests are cancelled
