"""Running calls to their end: one loop, whoever waits."""

import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Awaitable, Callable, Iterable
from contextlib import closing
from functools import partial
from typing import Any, TypeVar

import zenoh

from triquad_client.net.call import Ask, Batch, Call, Pause, ResultT, Run, Step
from triquad_client.net.connection import Connection, map_names

PendingT = TypeVar("PendingT")


class Driver(ABC):
    """Takes the steps of calls, one after the other; subclasses say how."""

    async def run_call(self, call: Call[ResultT]) -> ResultT:
        """What the call returns; raises what it raises."""
        with closing(call):
            resume = partial(call.send, None)
            while True:
                try:
                    step = resume()
                except StopIteration as end:
                    result: ResultT = end.value
                    return result
                try:
                    resume = partial(call.send, await self._take(step))
                except Exception as error:
                    resume = partial(call.throw, error)

    async def _take(self, step: Step) -> Any:
        if isinstance(step, Batch):
            return await self._replies(step)
        if isinstance(step, Pause):
            return await self._pause(step.seconds)
        return await self._work(step.job)

    @abstractmethod
    async def _replies(self, batch: Batch) -> list[Any]:
        """The replies to the requests, in the order of the items."""

    @abstractmethod
    async def _pause(self, seconds: float) -> None:
        """Let time pass."""

    @abstractmethod
    async def _work(self, job: Callable[[Run], Any]) -> Any:
        """What ``job`` returns."""


class BlockingDriver(Driver):
    """Takes the steps in the thread that makes the call. None of its coroutines ever waits."""

    def run(self, call: Call[ResultT]) -> ResultT:
        """What the call returns; raises what it raises."""
        coroutine = self.run_call(call)
        try:
            coroutine.send(None)  # to its end: it waits for nothing, so it needs no event loop
        except StopIteration as end:
            result: ResultT = end.value
            return result
        coroutine.close()
        raise AssertionError("a blocking driver waited for an event loop")

    async def _pause(self, seconds: float) -> None:
        time.sleep(seconds)

    async def _work(self, job: Callable[[Run], Any]) -> Any:
        return job(self.run)


class RemoteDriver(BlockingDriver):
    """Runs calls over a connection, in the threads that make them."""

    def __init__(
        self, connection: Connection, cancellation: zenoh.CancellationToken | None = None
    ) -> None:
        """Once ``cancellation`` is cancelled, every call ends with an error."""
        self._connection = connection
        self._cancellation = cancellation

    def maps(self) -> list[str]:
        """Names of the maps of all servers that can be reached."""
        return map_names(self._connection.look_for_maps(cancellation=self._cancellation))

    async def _replies(self, batch: Batch) -> list[Any]:
        return await exchange(batch, self._send, self._receive)

    async def _send(self, ask: Ask[Any]) -> Iterable[zenoh.Reply]:
        return self._connection.send(ask, cancellation=self._cancellation)

    async def _receive(self, ask: Ask[Any], replies: Iterable[zenoh.Reply]) -> Any:
        for reply in replies:
            return self._connection.read(ask, reply)
        raise self._connection.no_reply_error(ask, self.maps())


async def exchange(
    batch: Batch,
    send: Callable[[Ask[Any]], Awaitable[PendingT]],
    receive: Callable[[Ask[Any], PendingT], Awaitable[Any]],
) -> list[Any]:
    """The replies to a batch, of which ``batch.at_once`` requests are under way at a time."""
    waiting: deque[tuple[Ask[Any], PendingT]] = deque()
    replies = []
    for item in batch.items:
        ask = batch.request(item)
        waiting.append((ask, await send(ask)))
        if len(waiting) >= batch.at_once:
            replies.append(await receive(*waiting.popleft()))
    while waiting:
        replies.append(await receive(*waiting.popleft()))
    return replies
