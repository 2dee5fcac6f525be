"""A copy of a server's map, refreshed and asked in an event loop."""

import asyncio
from pathlib import Path

from triquad_client.calls.async_queries import AsyncMapQueries
from triquad_client.checks import Bounds
from triquad_client.documentation import documented_as
from triquad_client.net.call import AsyncRun, Call, ResultT
from triquad_client.offline.synced_map import LocalCopy, SyncedMap, SyncReport


@documented_as(SyncedMap)
class AsyncSyncedMap(LocalCopy, AsyncMapQueries):
    """The part of a map that a box needs, copied to this machine.

    It is :class:`SyncedMap` to be awaited: a thread answers the queries.
    """

    def __init__(self, path: Path, bounds: Bounds, run: AsyncRun) -> None:
        """Use ``AsyncClient.sync``."""
        LocalCopy.__init__(self, path, bounds)
        AsyncMapQueries.__init__(self, self._answer_in_thread)
        self._ask_server = run

    async def refresh(self) -> SyncReport:
        return await self._ask_server(self._update())

    async def _answer_in_thread(self, call: Call[ResultT]) -> ResultT:
        return await asyncio.to_thread(self._answer, call)
