"""Maps that answer from a copy of the server's, also while the link is down."""

import asyncio

from triquad_client.calls.async_queries import AsyncMapQueries, AsyncRun
from triquad_client.calls.queries import MapQueries
from triquad_client.net.call import Call, ResultT, Run
from triquad_client.offline.local_copy import LocalCopy, SyncReport


class SyncedMap(MapQueries):
    """The part of a map that a box needs, copied to this machine; several threads may ask it.

    Queries are answered from the copy: what it does not hold is unknown. Each is answered from one
    epoch, and ``at_epoch`` may be none but :attr:`epoch`.
    """

    def __init__(self, copy: LocalCopy, run: Run) -> None:
        """Use ``Client.sync``."""
        super().__init__(copy.run)
        self._copy = copy
        self._ask_server = run

    @property
    def epoch(self) -> int:
        """The server's epoch that the copy was made from."""
        return self._copy.epoch

    @property
    def age_s(self) -> float:
        """Seconds since the server had nothing newer: how old the copy may be at most."""
        return self._copy.age_s

    @property
    def report(self) -> SyncReport:
        """What it took to bring the copy up to date the last time."""
        return self._copy.report

    def refresh(self) -> SyncReport:
        """Fetch what changed on the server. Where that fails, the copy stays as it was.

        Raises:
            TriquadError: the server cannot be reached, as for any call of :class:`Client`.
            DownloadError: what arrived is not sound.
            OSError: the file cannot be written.
        """
        return self._ask_server(self._copy.update())


class AsyncSyncedMap(AsyncMapQueries):
    """As :class:`SyncedMap`, to be awaited."""

    def __init__(self, copy: LocalCopy, run: AsyncRun) -> None:
        """Use ``AsyncClient.sync``."""
        super().__init__(self._answer)
        self._copy = copy
        self._ask_server = run

    @property
    def epoch(self) -> int:
        """As :attr:`SyncedMap.epoch`."""
        return self._copy.epoch

    @property
    def age_s(self) -> float:
        """As :attr:`SyncedMap.age_s`."""
        return self._copy.age_s

    @property
    def report(self) -> SyncReport:
        """As :attr:`SyncedMap.report`."""
        return self._copy.report

    async def refresh(self) -> SyncReport:
        """As :meth:`SyncedMap.refresh`."""
        return await self._ask_server(self._copy.update())

    async def _answer(self, call: Call[ResultT]) -> ResultT:
        return await asyncio.to_thread(self._copy.run, call)
