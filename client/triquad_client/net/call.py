"""Calls: what a client asks a server and makes of the replies; and the drivers that run them.

A call is a generator. It yields steps, is sent what became of each, and returns the result. A
driver takes the steps in one loop, and its kind decides how to wait. To add a call, write its
generator with ``ask``, ``ask_each``, ``offload`` and ``retried``, and an operation in
``ClientOperations``, which makes a method of both clients from it.
"""

import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Awaitable, Callable, Generator, Iterable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, Protocol, TypeAlias, TypeVar

from triquad_format.errors import RefusedError
from triquad_format.wire.codec import Message

NEWEST = 0
"""Asks for the newest epoch, a published state of the map; another number pins that epoch."""

_PARTS_IN_FLIGHT = 4
"""Requests of one call that wait for their replies at the same time."""

_ATTEMPTS = 3

ItemT = TypeVar("ItemT")
ReplyT = TypeVar("ReplyT", bound=Message)
ResultT = TypeVar("ResultT")
PendingT = TypeVar("PendingT")


@dataclass(frozen=True)
class Ask(Generic[ReplyT]):
    """A request.

    Bulky ones go in the ``background``: a reply has the priority of its request, and a slow reader
    of large replies must not delay the distance queries of others.
    """

    operation: str  # of triquad_format.wire.keys
    message: Message
    kind: type[ReplyT]  # of the reply
    background: bool = False
    min_timeout_s: float = 0.0  # waits that long for the reply, where the connection would not
    server_wait_s: float = 0.0  # and that much longer: the server may answer as late as that


@dataclass(frozen=True)
class Batch:
    """A step: one request per item. It is sent what ``take`` makes of items and their replies, in
    the order of the items: of each while the next are on their way."""

    items: Iterable[Any]
    request: Callable[[Any], Ask[Any]]
    take: Callable[[Any, Any], Any]
    at_once: int  # requests that wait for their replies at the same time


@dataclass(frozen=True)
class Work:
    """A step: what would block an event loop. It is sent what ``job`` returns.

    The job runs in a thread where calls are awaited, and may run calls of its own.
    """

    job: Callable[["Run"], Any]


@dataclass(frozen=True)
class Pause:
    """A step: let time pass."""

    seconds: float


@dataclass(frozen=True)
class Put:
    """A step: something that is handed to the network after all that was before. It is sent what
    ``job`` returns."""

    job: Callable[[], Any]


Step: TypeAlias = Batch | Work | Pause | Put
Call: TypeAlias = Generator[Step, Any, ResultT]


class Run(Protocol):
    """Runs calls to their end, in the thread that makes them."""

    def __call__(self, call: Call[ResultT]) -> ResultT:
        """Return what the call returns; raises what it raises."""


class AsyncRun(Protocol):
    """Runs calls to their end, without blocking the event loop."""

    async def __call__(self, call: Call[ResultT]) -> ResultT:
        """Return what the call returns; raises what it raises."""


def ask(request: Ask[ReplyT]) -> Call[ReplyT]:
    """Return the reply to one request."""
    (reply,) = yield from ask_each([request], lambda only: only)
    return reply


def ask_each(
    items: Iterable[ItemT], request: Callable[[ItemT], Ask[ReplyT]], at_once: int = _PARTS_IN_FLIGHT
) -> Call[list[ReplyT]]:
    """Return the replies to one request per item; each is made in its turn, maybe in a thread."""
    return (yield from take_each(items, request, lambda _, reply: reply, at_once))


def take_each(
    items: Iterable[ItemT],
    request: Callable[[ItemT], Ask[ReplyT]],
    take: Callable[[ItemT, ReplyT], ResultT],
    at_once: int = _PARTS_IN_FLIGHT,
) -> Call[list[ResultT]]:
    """Return what ``take``, which must be quick, makes of each item and its reply."""
    taken: list[ResultT] = yield Batch(items, request, take, at_once)
    return taken


def offload(job: Callable[[Run], ResultT]) -> Call[ResultT]:
    """Return what ``job`` returns: long computing, or files."""
    result: ResultT = yield Work(job)
    return result


def put(job: Callable[[], ResultT]) -> Call[ResultT]:
    """Return what ``job`` returns, which gives something to the network, in the order of calls."""
    result: ResultT = yield Put(job)
    return result


def retried(code: str, attempt: Callable[[], Call[ResultT]]) -> Call[ResultT]:
    """Return what ``attempt`` returns; where the server refuses with ``code``, it is tried again.

    This is for questions of several requests, which the server can forget meanwhile.
    """
    for _ in range(_ATTEMPTS - 1):
        try:
            return (yield from attempt())
        except RefusedError as error:
            if error.code != code:
                raise
    return (yield from attempt())


class Driver(ABC):
    """Takes the steps of calls, one after the other; subclasses say how."""

    async def run_call(self, call: Call[ResultT]) -> ResultT:
        """Return what the call returns; raises what it raises."""
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
        if isinstance(step, Put):
            return await self.in_order(step.job)
        return await self._work(step.job)

    @abstractmethod
    async def _replies(self, batch: Batch) -> list[Any]:
        """Return what is made of the replies to the requests, in the order of the items."""

    @abstractmethod
    async def _pause(self, seconds: float) -> None:
        """Let time pass."""

    @abstractmethod
    async def in_order(self, job: Callable[[], ResultT]) -> ResultT:
        """Return what ``job`` returns, run after all that was sent before."""

    @abstractmethod
    async def _work(self, job: Callable[[Run], Any]) -> Any:
        """Return what ``job`` returns."""


class BlockingDriver(Driver):
    """Takes the steps in the thread that makes the call. None of its coroutines ever waits."""

    def run(self, call: Call[ResultT]) -> ResultT:
        """Return what the call returns; raises what it raises."""
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

    async def in_order(self, job: Callable[[], ResultT]) -> ResultT:
        """Return what ``job`` returns."""
        return job()

    async def _work(self, job: Callable[[Run], Any]) -> Any:
        return job(self.run)


async def exchange(
    batch: Batch,
    send: Callable[[Ask[Any]], Awaitable[PendingT]],
    receive: Callable[[Ask[Any], PendingT], Awaitable[Any]],
) -> list[Any]:
    """Return what is made of a batch's replies; ``batch.at_once`` are awaited at a time."""
    waiting: deque[tuple[Any, Ask[Any], PendingT]] = deque()
    taken = []

    async def take_first() -> None:
        item, request, pending = waiting.popleft()
        taken.append(batch.take(item, await receive(request, pending)))

    for item in batch.items:
        request = batch.request(item)
        waiting.append((item, request, await send(request)))
        if len(waiting) >= batch.at_once:
            await take_first()
    while waiting:
        await take_first()
    return taken
