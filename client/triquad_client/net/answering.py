"""Requests, and who answers them: a server at the other end of a connection, or a map here."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

from triquad_format.errors import RefusedError
from triquad_format.wire.codec import Message

NEWEST = 0
"""Asks for the newest epoch, a published state of the map; another number pins that epoch."""

PARTS_IN_FLIGHT = 4
"""Requests of one call that wait for their replies at the same time."""

_ATTEMPTS = 3

ReplyT = TypeVar("ReplyT", bound=Message)
ResultT = TypeVar("ResultT")


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


class Answering(ABC):
    """Answers requests."""

    @abstractmethod
    def replies(
        self, asks: Iterable[Ask[ReplyT]], at_once: int = PARTS_IN_FLIGHT
    ) -> Iterator[ReplyT]:
        """Yield the reply to each request, in their order; ``at_once`` are awaited at a time."""

    def ask(self, request: Ask[ReplyT]) -> ReplyT:
        """Return the reply to one request."""
        return next(iter(self.replies([request])))


def retried(code: str, attempt: Callable[[], ResultT]) -> ResultT:
    """Return what ``attempt`` returns; where the server refuses with ``code``, it is tried again.

    This is for questions of several requests, which the server can forget meanwhile.
    """
    for _ in range(_ATTEMPTS - 1):
        try:
            return attempt()
        except RefusedError as error:
            if error.code != code:
                raise
    return attempt()
