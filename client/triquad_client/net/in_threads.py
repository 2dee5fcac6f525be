"""Blocking methods for event loops: each call runs in a thread, and is cancelled with its task."""

import asyncio
import functools
from collections import defaultdict
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Concatenate, ParamSpec, TypeVar

import zenoh

from triquad_client.net.connection import cancellable, closed_error

_CALLS_AT_ONCE = 32
"""Calls of one kind that go on at the same time; others wait for their turn. Servers refuse what
exceeds their queue (64 requests, where it is not set otherwise) as ``busy``."""

_MOST_THREADS = 1_000
"""More than calls of all kinds may go on."""

_IN_ORDER = {"publish_scan", "publish_depth", "restart_source"}
"""Methods whose effects are in the order of their calls: one thread runs them all."""

ArgumentsP = ParamSpec("ArgumentsP")
ResultT = TypeVar("ResultT")


class Threads:
    """The threads of a client for an event loop."""

    def __init__(self) -> None:
        self._workers = ThreadPoolExecutor(_MOST_THREADS, "triquad-call")  # made as they are needed
        self._sender = ThreadPoolExecutor(1, "triquad-sender")
        self._slots: defaultdict[str, asyncio.Semaphore] = defaultdict(
            lambda: asyncio.Semaphore(_CALLS_AT_ONCE)
        )

    async def run(self, name: str, call: Callable[[], ResultT]) -> ResultT:
        """Return what ``call``, of the method called ``name``, returns.

        Where the task is cancelled, so are the call's requests; it has ended then.
        """
        if name in _IN_ORDER:
            return await self._run(self._sender, call)
        async with self._slots[name]:
            return await self._run(self._workers, call)

    async def close(self, close: Callable[[], None]) -> None:
        """Call ``close``, which ends what goes on, in a thread; no call may follow."""
        try:
            await asyncio.wrap_future(self._workers.submit(close))
        except RuntimeError:  # they were shut down: it is closed
            return
        self._sender.shutdown(wait=False)
        self._workers.shutdown(wait=False)

    async def _run(self, threads: ThreadPoolExecutor, call: Callable[[], ResultT]) -> ResultT:
        token = zenoh.CancellationToken()
        try:
            submitted = threads.submit(_cancelled_by, token, call)
        except RuntimeError as error:  # they were shut down
            raise closed_error() from error
        running = asyncio.wrap_future(submitted)
        try:
            return await asyncio.shield(running)
        except asyncio.CancelledError:
            token.cancel()
            submitted.cancel()  # where it has not begun
            await asyncio.wait({running})  # until it has cleared up
            running.cancelled() or running.exception()  # of which nobody wants to know
            raise


class InThreads:
    """An object whose methods are those of a blocking one, to be awaited."""

    def __init__(self, blocking: Any, threads: Threads) -> None:
        self._blocking = blocking
        self._threads = threads


def awaited(
    method: Callable[Concatenate[Any, ArgumentsP], ResultT],
) -> Callable[Concatenate[Any, ArgumentsP], Coroutine[Any, Any, ResultT]]:
    """Return a blocking object's method as one of :class:`InThreads`, documented alike."""

    @functools.wraps(method)
    async def call(
        self: InThreads, /, *args: ArgumentsP.args, **kwargs: ArgumentsP.kwargs
    ) -> ResultT:
        blocking, threads = self._blocking, self._threads
        return await threads.run(
            method.__name__, functools.partial(method, blocking, *args, **kwargs)
        )

    return call


def _cancelled_by(token: zenoh.CancellationToken, call: Callable[[], ResultT]) -> ResultT:
    with cancellable(token):
        return call()
