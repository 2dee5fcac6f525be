"""Calls: what a client asks a server and makes of the replies, without the waiting.

A call is a generator. It yields steps, is sent what became of each, and returns the result. Who
runs it decides how to wait (:mod:`triquad_client.net.driver`). To add a call, write its generator
with the helpers below, and a line in ``Client`` and ``AsyncClient``.
"""

from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray
from triquad_format.errors import RefusedError
from triquad_format.wire.codec import Message
from triquad_format.wire.messages import MapReply

from triquad_client import checks
from triquad_client.errors import BadReplyError

NEWEST = 0
"""Asks for the newest epoch, a published state of the map; another number pins that epoch."""

_PARTS_IN_FLIGHT = 4
"""Requests of one call that wait for their replies at the same time."""

_ATTEMPTS = 3
_ORIGIN_SAMPLE = 1000

ItemT = TypeVar("ItemT")
ReplyT = TypeVar("ReplyT", bound=Message)
MapReplyT = TypeVar("MapReplyT", bound=MapReply)
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
    items: Iterable[ItemT], request: Callable[[ItemT], Ask[ReplyT]], at_once: int = _PARTS_IN_FLIGHT
) -> Call[list[ReplyT]]:
    """The replies to one request per item; each is made when its turn comes, maybe in a thread."""
    replies: list[ReplyT] = yield Batch(items, request, at_once)
    return replies


def offload(job: Callable[[Run], ResultT]) -> Call[ResultT]:
    """What ``job`` returns: long computing, or files."""
    result: ResultT = yield Work(job)
    return result


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


def in_parts(
    count: int, most: int, request: Callable[[slice, int], Ask[MapReplyT]], at_epoch: int | None
) -> Call[Sequence[MapReplyT]]:
    """The replies about ``count`` items, ``most`` at a time, all from one epoch.

    ``request`` makes what is asked about some of the items, of the epoch of some number.

    Raises:
        InvalidInputError: ``at_epoch`` is neither the number of an epoch nor ``None``, the newest.
    """

    def parts(epoch: int) -> Call[Sequence[MapReplyT]]:
        first = yield from ask(request(slice(0, most), epoch))
        if count <= most:
            return [first]
        rest = yield from ask_each(
            range(most, count, most), lambda start: request(slice(start, start + most), first.epoch)
        )
        return [first, *rest]

    epoch = checks.chosen_epoch(at_epoch)
    if epoch is not None:
        return (yield from parts(epoch))
    # The map may go on while the parts are under way: then all of it is asked again.
    return (yield from retried("epoch_gone", lambda: parts(NEWEST)))


def joined(replies: Sequence[MapReply], flags: Sequence[str] = ()) -> dict[str, Any]:
    """The fields of replies about parts as one: arrays end to end, ``flags`` as truth values.

    Raises:
        BadReplyError: the replies do not fit together.
    """
    try:
        fields = {
            name: np.concatenate([getattr(reply, name) for reply in replies])
            if isinstance(value, np.ndarray)
            else value
            for name, value in vars(replies[0]).items()
        }
    except ValueError as error:
        raise BadReplyError(f"the replies about parts do not fit together: {error}") from error
    return fields | {flag: fields[flag].astype(np.bool_) for flag in flags}


def origin_of(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """An origin [3] among points [N, 3], from which they travel in single precision."""
    # The median, so that a few far points do not cost the others their precision; of a sample,
    # as it takes longer than all the rest.
    some = points[:: max(1, len(points) // _ORIGIN_SAMPLE)]
    return np.asarray(np.median(some, axis=0)) if len(points) else np.zeros(3)


def offsets(points: NDArray[np.float64], origin: NDArray[np.float64]) -> NDArray[np.float32]:
    """Points [N, 3] as they travel: relative to an origin [3]."""
    return (points - origin).astype(np.float32)
