"""Blocking methods for event loops: each call runs in a thread, and is cancelled with its task."""

import asyncio
import functools
import threading
import weakref
from collections import defaultdict
from collections.abc import Callable, Coroutine
from concurrent.futures import Future, wait
from typing import Any, Concatenate, ParamSpec, TypeVar

import zenoh

from triquad_client.net.connection import cancellable

_CALLS_AT_ONCE = 32
"""Calls of one kind that go on at the same time; others wait for their turn. Servers refuse what
exceeds their queue (64 requests, where it is not set otherwise) as ``busy``."""

_WAITING = {"next", "catch_up", "flush", "settle"}
"""Methods that mostly wait for the server to learn: any number goes on at the same time."""

_IN_ORDER = {"publish_scan", "publish_depth", "restart_source"}
"""Methods whose effects are in the order of their calls: one goes on at a time."""

_END_S = 1.0  # for what still runs when the program ends, and its connection was closed

ArgumentsP = ParamSpec("ArgumentsP")
ResultT = TypeVar("ResultT")

_running: set[Future[Any]] = set()


def in_thread(call: Callable[[], ResultT]) -> asyncio.Future[ResultT]:
    """Start ``call`` in a thread of its own, for which the end of the program need not wait.

    Raises:
        RuntimeError: the system has no thread left.
    """
    result: Future[ResultT] = Future()
    result.set_running_or_notify_cancel()  # it cannot be cancelled

    def run() -> None:
        try:
            result.set_result(call())
        except BaseException as error:
            result.set_exception(error)

    threading.Thread(target=run, name="triquad-call", daemon=True).start()
    _running.add(result)
    result.add_done_callback(_running.discard)
    return asyncio.wrap_future(result)


class Threads:
    """The threads of a client for an event loop."""

    def __init__(self) -> None:
        self._order = asyncio.Semaphore(1)
        self._slots: defaultdict[str, asyncio.Semaphore] = defaultdict(
            lambda: asyncio.Semaphore(_CALLS_AT_ONCE)
        )

    async def run(self, name: str, call: Callable[[], ResultT]) -> ResultT:
        """Return what ``call``, of the method called ``name``, returns.

        Where the task is cancelled, so are the call's requests; it has ended then, unless it sends
        a scan, which is sent all the same.
        """
        token = zenoh.CancellationToken()
        turns = self._turns(name)
        await turns.acquire()
        try:
            running = in_thread(functools.partial(_cancelled_by, token, call))
        except BaseException:
            turns.release()
            raise

        def ended(running: asyncio.Future[ResultT]) -> None:
            turns.release()
            running.exception()  # of a cancelled task nobody wants to know it

        running.add_done_callback(ended)
        try:
            await asyncio.wait({running})
        except asyncio.CancelledError:
            token.cancel()
            if name not in _IN_ORDER:
                await asyncio.wait({running})  # until it has cleared up
            raise
        return running.result()

    def _turns(self, name: str) -> asyncio.Semaphore:
        if name in _WAITING:
            return asyncio.Semaphore()  # of this call alone
        return self._order if name in _IN_ORDER else self._slots[name]


class InThreads:
    """An object whose methods are those of a blocking one, to be awaited."""

    def __init__(self, blocking: Any, threads: Threads) -> None:
        self._blocking = blocking
        self._threads = threads

    def __repr__(self) -> str:
        return f"Async{self._blocking!r}"


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


def _wait_for_calls() -> None:
    wait(tuple(_running), _END_S)


# Finalizers run newest first: by then those of all connections, made later, have ended the calls.
# A thread that is within Zenoh must not come back into an interpreter that is no longer there.
weakref.finalize(Threads, _wait_for_calls)
