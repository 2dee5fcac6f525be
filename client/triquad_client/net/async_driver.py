"""Runs calls in tasks of an event loop, which none of them holds up.

Zenoh is told of a request in a thread of its own, one for all: sending blocks where the network is
slow, and scans keep their order. Replies come back through callbacks, which leave nothing to wait
for where a program ends without closing its client.
"""

import asyncio
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import zenoh

from triquad_client.net.blocking import BlockingDriver
from triquad_client.net.call import Ask, Batch, Call, Pause, ResultT, Run, Step
from triquad_client.net.connection import Connection, Receiver, closed_error, map_names

REQUESTS_IN_FLIGHT = 32
"""Requests of one operation, over all calls, that wait for their replies at the same time. Servers
refuse what exceeds their queue (64, where it is not set otherwise) as ``busy``."""

_WORKERS = 32
"""Downloads and long computations that go on at the same time."""

DoneT = TypeVar("DoneT")


class AsyncDriver:
    """Runs calls over a connection; for one event loop."""

    def __init__(self, connection: Connection, sender: ThreadPoolExecutor) -> None:
        """``sender`` has one thread, and is used for nothing else."""
        self._connection = connection
        self._sender = sender
        self._workers = ThreadPoolExecutor(_WORKERS, "triquad-worker")
        self._turns: defaultdict[str, asyncio.Semaphore] = defaultdict(
            lambda: asyncio.Semaphore(REQUESTS_IN_FLIGHT)
        )

    async def run(self, call: Call[ResultT]) -> ResultT:
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

    async def in_order(self, job: Callable[[], DoneT]) -> DoneT:
        """What ``job`` returns, run in the sending thread after all that was sent before."""
        return await _awaited(self._sender, job)

    async def maps(self) -> list[str]:
        """Names of the maps of all servers that can be reached."""
        with _cancelled_on_error() as cancellation:
            arrival = _Arrival.expected()
            await self.in_order(
                lambda: self._connection.look_for_maps(arrival.receiver, cancellation)
            )
            return map_names(await arrival.replies)

    async def close(self) -> None:
        """Close the connection; what is under way ends with :class:`ClosedError`."""
        # A thread of its own: all others may wait for what closing ends.
        closer = ThreadPoolExecutor(1, "triquad-closer")
        try:
            await asyncio.wrap_future(closer.submit(self._connection.close))
        finally:
            closer.shutdown(wait=False)
            self._sender.shutdown(wait=False)
            self._workers.shutdown(wait=False)

    async def _take(self, step: Step) -> Any:
        if isinstance(step, Batch):
            return await self._replies(step)
        if isinstance(step, Pause):
            return await asyncio.sleep(step.seconds)
        return await self._work(step.job)

    async def _replies(self, batch: Batch) -> list[Any]:
        waiting: deque[_Pending] = deque()
        replies = []
        with _cancelled_on_error() as cancellation:
            for item in batch.items:
                waiting.append(await self._send(batch.request(item), cancellation))
                if len(waiting) >= batch.at_once:
                    replies.append(await self._result(waiting.popleft()))
            while waiting:
                replies.append(await self._result(waiting.popleft()))
        return replies

    async def _send(self, ask: Ask[Any], cancellation: zenoh.CancellationToken) -> "_Pending":
        turn = self._turns[ask.operation]
        await turn.acquire()
        arrival = _Arrival.expected()
        arrival.replies.add_done_callback(lambda _: turn.release())
        try:
            await self.in_order(lambda: self._connection.send(ask, arrival.receiver, cancellation))
        except BaseException:
            arrival.replies.cancel()
            raise
        return _Pending(ask, arrival)

    async def _result(self, pending: "_Pending") -> Any:
        for reply in await pending.arrival.replies:
            return self._connection.read(pending.ask, reply)
        if self._connection.closed:
            raise closed_error()
        raise self._connection.silence(pending.ask, await self.maps())

    async def _work(self, job: Callable[[Run], Any]) -> Any:
        """What a job returns; where the task is cancelled, so are the requests of the job."""
        with _cancelled_on_error() as cancellation:
            run = BlockingDriver(self._connection, cancellation).run
            working = asyncio.ensure_future(_awaited(self._workers, lambda: job(run)))
            try:
                return await asyncio.shield(working)
            except asyncio.CancelledError:
                cancellation.cancel()
                await asyncio.wait({working})  # until it has cleared up
                raise


@dataclass(frozen=True)
class _Arrival:
    """Where the replies to a request will be, and what Zenoh shall do with them."""

    replies: asyncio.Future[list[zenoh.Reply]]
    receiver: Receiver

    @classmethod
    def expected(cls) -> "_Arrival":
        """For the running event loop."""
        loop = asyncio.get_running_loop()
        future: asyncio.Future[list[zenoh.Reply]] = loop.create_future()
        replies: list[zenoh.Reply] = []

        def settle() -> None:
            if not future.done():
                future.set_result(replies)

        def end() -> None:  # in a thread of Zenoh
            with suppress(RuntimeError):  # the loop is closed: nobody waits any more
                loop.call_soon_threadsafe(settle)

        return cls(future, zenoh.handlers.Callback(replies.append, end, indirect=False))


@dataclass(frozen=True)
class _Pending:
    """A request on its way."""

    ask: Ask[Any]
    arrival: _Arrival


async def _awaited(threads: ThreadPoolExecutor, job: Callable[[], DoneT]) -> DoneT:
    try:
        done = threads.submit(job)
    except RuntimeError as error:  # they were shut down
        raise closed_error() from error
    return await asyncio.wrap_future(done)


@contextmanager
def _cancelled_on_error() -> Iterator[zenoh.CancellationToken]:
    """A token for requests, which are cancelled where the block fails or its task is cancelled."""
    token = zenoh.CancellationToken()
    try:
        yield token
    except BaseException:
        token.cancel()
        raise
