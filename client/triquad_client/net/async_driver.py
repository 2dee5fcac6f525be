"""Runs calls in tasks of an event loop, which none of them blocks.

Zenoh is given a request in a thread of its own, one for all: sending blocks where the network is
slow, and scans keep their order. Replies come back through callbacks, which leave nothing to wait
for where a program ends without closing its client.
"""

import asyncio
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias, TypeVar

import zenoh

from triquad_client.net.call import Ask, Batch, Driver, Run, exchange
from triquad_client.net.connection import (
    Connection,
    Receiver,
    RemoteDriver,
    closed_error,
    map_names,
)

_REQUESTS_IN_FLIGHT = 32
"""Requests of one operation, over all calls, that wait for their replies at the same time. Servers
refuse what exceeds their queue (64, where it is not set otherwise) as ``busy``."""

_WORKERS = 32
"""Downloads and long computations that go on at the same time."""

DoneT = TypeVar("DoneT")

_Replies: TypeAlias = "asyncio.Future[list[zenoh.Reply]]"


class AsyncDriver(Driver):
    """Runs calls over a connection; for one event loop."""

    def __init__(self, connection: Connection, sender: ThreadPoolExecutor) -> None:
        """Send in ``sender``, which has one thread, and is used for nothing else."""
        self._connection = connection
        self._sender = sender
        self._workers = ThreadPoolExecutor(_WORKERS, "triquad-worker")
        self._slots: defaultdict[str, asyncio.Semaphore] = defaultdict(
            lambda: asyncio.Semaphore(_REQUESTS_IN_FLIGHT)
        )

    async def in_order(self, job: Callable[[], DoneT]) -> DoneT:
        """Return what ``job`` returns, run in the sending thread after all that was sent before."""
        return await _in_thread(self._sender, job)

    async def maps(self) -> list[str]:
        """Return names of the maps of all servers that can be reached."""
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

    async def _replies(self, batch: Batch) -> list[Any]:
        with _cancelled_on_error() as cancellation:
            return await exchange(batch, partial(self._send, cancellation), self._receive)

    async def _pause(self, seconds: float) -> None:
        await asyncio.sleep(seconds)

    async def _send(self, cancellation: zenoh.CancellationToken, ask: Ask[Any]) -> _Replies:
        slot = self._slots[ask.operation]
        await slot.acquire()
        arrival = _Arrival.expected()
        arrival.replies.add_done_callback(lambda _: slot.release())
        try:
            await self.in_order(lambda: self._connection.send(ask, arrival.receiver, cancellation))
        except BaseException:
            arrival.replies.cancel()
            raise
        return arrival.replies

    async def _receive(self, ask: Ask[Any], replies: _Replies) -> Any:
        for reply in await replies:
            return self._connection.read(ask, reply)
        raise self._connection.no_reply_error(ask, await self.maps())

    async def _work(self, job: Callable[[Run], Any]) -> Any:
        """Return what a job returns; where the task is cancelled, so are the job's requests."""
        with _cancelled_on_error() as cancellation:
            run = RemoteDriver(self._connection, cancellation).run
            working = asyncio.ensure_future(_in_thread(self._workers, lambda: job(run)))
            try:
                return await asyncio.shield(working)
            except asyncio.CancelledError:
                cancellation.cancel()
                await asyncio.wait({working})  # until it has cleared up
                raise


@dataclass(frozen=True)
class _Arrival:
    """The place of the replies to a request, and what Zenoh shall do with them."""

    replies: _Replies
    receiver: Receiver

    @classmethod
    def expected(cls) -> "_Arrival":
        """Make one for the running event loop."""
        loop = asyncio.get_running_loop()
        future: _Replies = loop.create_future()
        replies: list[zenoh.Reply] = []

        def settle() -> None:
            if not future.done():
                future.set_result(replies)

        def end() -> None:  # in a thread of Zenoh
            with suppress(RuntimeError):  # the loop is closed: nobody waits any more
                loop.call_soon_threadsafe(settle)

        return cls(future, zenoh.handlers.Callback(replies.append, end, indirect=False))


async def _in_thread(threads: ThreadPoolExecutor, job: Callable[[], DoneT]) -> DoneT:
    try:
        done = threads.submit(job)
    except RuntimeError as error:  # they were shut down
        raise closed_error() from error
    return await asyncio.wrap_future(done)


@contextmanager
def _cancelled_on_error() -> Iterator[zenoh.CancellationToken]:
    """Yield a token for requests, which are cancelled where the block fails or is cancelled."""
    token = zenoh.CancellationToken()
    try:
        yield token
    except BaseException:
        token.cancel()
        raise
