"""Runs calls over a connection, in the thread that makes them."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import zenoh

from triquad_client.net.call import Ask, Batch
from triquad_client.net.connection import Connection, closed_error, map_names
from triquad_client.net.driver import BlockingDriver, exchange


class RemoteDriver(BlockingDriver):
    """Runs calls over a connection; for several threads."""

    def __init__(
        self,
        connection: Connection,
        cancellation: zenoh.CancellationToken | None = None,
    ) -> None:
        """Once ``cancellation`` is cancelled, every call ends with an error."""
        self._connection = connection
        self._cancellation = cancellation

    def maps(self) -> list[str]:
        """Names of the maps of all servers that can be reached."""
        return map_names(self._connection.look_for_maps(cancellation=self._cancellation))

    async def _replies(self, batch: Batch) -> list[Any]:
        return await exchange(batch, self._send, self._receive)

    async def _send(self, ask: Ask[Any]) -> "_Pending":
        return _Pending(ask, self._connection.send(ask, cancellation=self._cancellation))

    async def _receive(self, pending: "_Pending") -> Any:
        for reply in pending.replies:
            return self._connection.read(pending.ask, reply)
        if self._connection.closed:
            raise closed_error()
        raise self._connection.no_reply_error(pending.ask, self.maps())


@dataclass(frozen=True)
class _Pending:
    """A request on its way, and where its replies come from."""

    ask: Ask[Any]
    replies: Iterable[zenoh.Reply]
