"""Calls: what a client asks a server and makes of the replies, without the waiting.

A call is a generator. It yields steps, is sent what became of each, and returns the result. Who
runs it decides how to wait (:mod:`triquad_client.net.driver`). To add a call, write its generator
with the helpers below, and a line in ``Client`` and ``AsyncClient``.
"""

from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeAlias, TypeVar

from triquad_format.errors import RefusedError
from triquad_format.wire.codec import Message

PARTS_IN_FLIGHT = 4
"""Requests of one call that wait for their replies at the same time."""

_ATTEMPTS = 3

ItemT = TypeVar("ItemT")
ReplyT = TypeVar("ReplyT", bound=Message)
ResultT = TypeVar("ResultT")


@dataclass(frozen=True)
class Ask(Generic[ReplyT]):
    """A request.

    Bulky ones go in the ``background``: a reply has the priority of its request, and a slow reader
    of large replies must not hold up the distance queries of others.
    """

    operation: str  # of triquad_format.wire.keys
    message: Message
    kind: type[ReplyT]  # of the reply
    background: bool = False
    min_timeout_s: float = 0.0  # waits that long for the reply, where the connection would not
    server_wait_s: float = 0.0  # and so much longer: the server may answer as late as that


@dataclass(frozen=True)
class Batch:
    """A step: one request per item. It is sent the replies, in the order of the items."""

    items: Iterable[Any]
    request: Callable[[Any], Ask[Any]]
    at_once: int  # requests that wait for their replies at the same time


@dataclass(frozen=True)
class Work:
    """A step: what would hold up an event loop. It is sent what ``job`` returns.

    The job runs in a thread where calls are awaited, and may run calls of its own.
    """

    job: Callable[["Run"], Any]


@dataclass(frozen=True)
class Pause:
    """A step: let time pass."""

    seconds: float


Step: TypeAlias = Batch | Work | Pause
Call: TypeAlias = Generator[Step, Any, ResultT]


class Run(Protocol):
    """Runs calls to their end, in the thread that makes them."""

    def __call__(self, call: Call[ResultT]) -> ResultT:
        """What the call returns; raises what it raises."""
        ...


class AsyncRun(Protocol):
    """Runs calls to their end, without holding up the event loop."""

    async def __call__(self, call: Call[ResultT]) -> ResultT:
        """What the call returns; raises what it raises."""
        ...


def ask(request: Ask[ReplyT]) -> Call[ReplyT]:
    """The reply to one request."""
    (reply,) = yield from ask_each([request], lambda only: only)
    return reply


def ask_each(
    items: Iterable[ItemT],
    request: Callable[[ItemT], Ask[ReplyT]],
    at_once: int = PARTS_IN_FLIGHT,
) -> Call[list[ReplyT]]:
    """The replies to one request per item; each is made when its turn comes, maybe in a thread."""
    replies: list[ReplyT] = yield Batch(items, request, at_once)
    return replies


def offload(job: Callable[[Run], ResultT]) -> Call[ResultT]:
    """What ``job`` returns: long computing, or files."""
    result: ResultT = yield Work(job)
    return result


def pause(seconds: float) -> Call[None]:
    """Nothing, after a time."""
    yield Pause(seconds)


def retried(code: str, attempt: Callable[[], Call[ResultT]]) -> Call[ResultT]:
    """What ``attempt`` returns; where the server refuses with ``code``, it is tried anew.

    For questions of several requests, which the server can forget while they are under way.
    """
    for _ in range(_ATTEMPTS - 1):
        try:
            return (yield from attempt())
        except RefusedError as error:
            if error.code != code:
                raise
    return (yield from attempt())
