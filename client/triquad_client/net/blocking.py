"""Runs calls in the thread that makes them."""

import time
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import zenoh

from triquad_client.net.call import Ask, Batch, Call, Pause, ResultT, Step, finished
from triquad_client.net.connection import Connection, closed_error, map_names


class BlockingDriver:
    """Runs calls over a connection; for several threads."""

    def __init__(
        self,
        connection: Connection,
        cancellation: zenoh.CancellationToken | None = None,
    ) -> None:
        """Once ``cancellation`` is cancelled, every call ends with an error."""
        self._connection = connection
        self._cancellation = cancellation

    def run(self, call: Call[ResultT]) -> ResultT:
        """What the call returns; raises what it raises."""
        return finished(call, self._take)

    def maps(self) -> list[str]:
        """Names of the maps of all servers that can be reached."""
        return map_names(self._connection.look_for_maps(cancellation=self._cancellation))

    def _take(self, step: Step) -> Any:
        if isinstance(step, Batch):
            return list(self._replies(step))
        if isinstance(step, Pause):
            return time.sleep(step.seconds)
        return step.job(self.run)

    def _replies(self, batch: Batch) -> Iterator[Any]:
        waiting: deque[_Pending] = deque()
        for item in batch.items:
            waiting.append(self._send(batch.request(item)))
            if len(waiting) >= batch.at_once:
                yield self._result(waiting.popleft())
        while waiting:
            yield self._result(waiting.popleft())

    def _send(self, ask: Ask[Any]) -> "_Pending":
        return _Pending(ask, self._connection.send(ask, cancellation=self._cancellation))

    def _result(self, pending: "_Pending") -> Any:
        for reply in pending.replies:
            return self._connection.read(pending.ask, reply)
        if self._connection.closed:
            raise closed_error()
        raise self._connection.silence(pending.ask, self.maps())


@dataclass(frozen=True)
class _Pending:
    """A request on its way, and where its replies come from."""

    ask: Ask[Any]
    replies: Iterable[zenoh.Reply]
