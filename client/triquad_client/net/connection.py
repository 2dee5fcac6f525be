"""Requests, and who answers them: a server at the other end of a connection, or a map in memory."""

import copy
import secrets
import time
import weakref
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar, cast

import zenoh
from triquad_format.errors import RefusedError, WireError
from triquad_format.printable import printable
from triquad_format.wire import codec, keys
from triquad_format.wire.bounds import check_answers
from triquad_format.wire.codec import Message, Request
from triquad_format.wire.messages import ErrorReply, RequestOrigin
from triquad_format.wire.status_messages import StatusRequest

from triquad_client import checks
from triquad_client.errors import (
    BadReplyError,
    ClosedError,
    ConnectError,
    NoReplyError,
    RequestTimeoutError,
    UnknownMapError,
)

NEWEST = 0
"""Asks for the newest epoch, a published state of the map; another number pins that epoch."""

PARTS_IN_FLIGHT = 4
"""Requests of one call that wait for their replies at the same time."""

_ATTEMPTS = 3

_LIVELINESS_TIMEOUT_S = 3.0
_MAX_REASON = 2_000  # characters of why a request was refused

ReplyT = TypeVar("ReplyT", bound=Message)
ResultT = TypeVar("ResultT")

_cancellation: ContextVar[zenoh.CancellationToken | None] = ContextVar("cancellation", default=None)
"""The token that ends the requests of the running call."""


class Answering(ABC):
    """Answers requests."""

    @abstractmethod
    def replies(self, requests: Iterable[Request[ReplyT]]) -> Iterator[ReplyT]:
        """Yield the reply to each request, in their order."""

    def ask(self, request: Request[ReplyT]) -> ReplyT:
        """Return the reply to one request."""
        return next(iter(self.replies([request])))


class Connection(Answering):
    """An open session, bound to one map. Safe for use by several threads."""

    def __init__(
        self,
        session: zenoh.Session,
        map_name: str,
        timeout_s: float,
        *,
        max_download_bytes: int,
        local: bool = False,
        where: str = "",
    ) -> None:
        self._session = session
        self._id = str(session.info.zid())
        # A session that a program forgot is closed before Python ends: Zenoh's threads must not
        # come back into an interpreter that is no longer there.
        self._close = weakref.finalize(self, session.close)
        self.map_name = map_name
        self.where = where  # of the server, in words
        self.timeout_s = timeout_s
        self.max_download_bytes = max_download_bytes  # of a map file, or the mesh of a box
        self.local = local  # places count from the map's origin

    @property
    def is_closed(self) -> bool:
        """True where the connection was closed.

        Zenoh is not asked: its answer waits for a lock and keeps Python's meanwhile, while a thread
        of Zenoh that has the former may want the latter, to report that a request has ended.
        """
        return not self._close.alive

    def close(self) -> None:
        """Close the session; closing twice does no harm. What is under way ends unanswered."""
        self._close()

    def replies(self, requests: Iterable[Request[ReplyT]]) -> Iterator[ReplyT]:
        """Yield the reply to each request, in their order; a few are under way at a time.

        Nothing of a reply is used before all of it was checked.

        Raises:
            RefusedError: the server refused.
            RequestTimeoutError: there was no reply in time.
            BadReplyError: a reply cannot be decoded, or is no answer to what was asked.
            NoReplyError: there was none; also UnknownMapError, where the map is not there.
            ClosedError: the session was closed.
            ConnectError: it is broken.
        """
        waiting: deque[tuple[Request[ReplyT], Iterable[zenoh.Reply]]] = deque()
        for request in requests:
            waiting.append((request, self.sent(request)))
            if len(waiting) >= PARTS_IN_FLIGHT:
                yield self.received(*waiting.popleft())
        while waiting:
            yield self.received(*waiting.popleft())

    def ask_until_done(self, request: Request[ReplyT], timeout_s: float) -> ReplyT:
        """Return the reply to a request with a ticket, which is repeated while work is under way.

        Raises:
            RequestTimeoutError: it is not done after ``timeout_s``, or the server does not answer.
            RefusedError: the server refused.
        """
        deadline = checks.deadline(timeout_s)
        while True:
            try:
                return self.ask(request)
            except RefusedError as error:
                if error.code != "under_way":
                    raise
                told = error.message
            if time.monotonic() > deadline:
                raise RequestTimeoutError(
                    f"{self._key(request)} was not done within {timeout_s:g} s: {told}, and will "
                    "finish it"
                )

    def put(self, key: str, message: Message) -> None:
        """Publish a message; blocks where the network is slower than the publisher.

        Raises:
            ClosedError: the session was closed.
            ConnectError: it is broken.
        """
        try:
            self._session.put(
                key,
                codec.encode(message),
                encoding=keys.encoding(type(message)),
                # The default drops large samples even on an idle network.
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.DATA,
            )
        except zenoh.ZError as error:
            raise self._broken(error) from error

    def maps(self) -> list[str]:
        """Return the maps of all servers in reach; raises as :meth:`put`."""
        return sorted({map_name for map_name, _ in self.servers() if keys.is_name(map_name)})

    def servers(self, map_name: str = "*") -> list[tuple[str, str]]:
        """Return maps in reach, or that of a name, each with a server; raises as :meth:`put`."""
        try:
            replies = self._session.liveliness().get(
                keys.alive_key(map_name, "*"),
                timeout=_LIVELINESS_TIMEOUT_S,
                cancellation_token=_cancellation.get(),
            )
        except zenoh.ZError as error:
            raise self._broken(error) from error
        found = (str(reply.ok.key_expr).split("/") for reply in replies if reply.ok)
        return [(key[1], key[-1]) for key in found]

    def start_stage(self) -> str | None:
        """Return what the server of the map does before it is ready; None: there is none such."""
        try:
            self.ask(StatusRequest())
        except RefusedError as error:
            return error.message if error.code == "starting" else None
        except (NoReplyError, UnknownMapError, RequestTimeoutError):
            return None
        return "it is about to be ready"

    def of_map(self, map_name: str) -> "Connection":
        """Return a connection to another map, by the same session: it is closed with this one."""
        other = copy.copy(self)
        other.map_name = map_name
        return other

    def sent(self, request: Request[Any]) -> Iterable[zenoh.Reply]:
        """Send a request, and return the replies to come; raises as :meth:`put`."""
        try:
            return self._session.get(
                self._key(request),
                payload=codec.encode(request),
                encoding=keys.encoding(type(request)),
                attachment=codec.encode(RequestOrigin(self._id, self.timeout_s, self.local)),
                timeout=self.timeout_s,
                priority=zenoh.Priority.BACKGROUND if request.background else zenoh.Priority.DATA,
                congestion_control=zenoh.CongestionControl.BLOCK,
                consolidation=zenoh.ConsolidationMode.NONE,
                cancellation_token=_cancellation.get(),
            )
        except zenoh.ZError as error:
            raise self._broken(error) from error

    def received(self, request: Request[ReplyT], replies: Iterable[zenoh.Reply]) -> ReplyT:
        """Return the reply to a request that was sent; raises as :meth:`replies`."""
        for reply in replies:
            return self._read(request, reply)
        raise self._no_reply_error(request)

    def _read(self, request: Request[ReplyT], reply: zenoh.Reply) -> ReplyT:
        try:
            if reply.ok is not None:
                answer = codec.decode(request.reply, reply.ok.payload.to_bytes())
                check_answers(request, answer)
                return cast(ReplyT, answer)
            payload = b"" if reply.err is None else reply.err.payload.to_bytes()
            if payload == b"Timeout":
                raise RequestTimeoutError(
                    f"no reply on {self._key(request)} within {self.timeout_s:g} s, the timeout_s "
                    "of connect: the server is busy, or does not answer any more"
                )
            reason = codec.decode(ErrorReply, payload)
        except WireError as error:
            raise BadReplyError(f"reply on {self._key(request)}: {error}") from error
        raise RefusedError(
            printable(reason.code, _MAX_REASON), printable(reason.message, _MAX_REASON)
        )

    def _no_reply_error(self, request: Request[Any]) -> Exception:
        if self.is_closed:
            return ClosedError("the client is closed")
        available = self.maps()
        info = self._session.info  # last: where a server is killed, its map may go before the link
        if not (info.routers_zid() or info.peers_zid()):
            return ConnectError(
                "the link to the server is down; it is set up again once the server is back"
            )
        if self.map_name not in available:
            return UnknownMapError(self.map_name, available)
        why = (
            "access control forbids it (without roles to all but programs of the server's machine "
            "that connect to 127.0.0.1, with roles to all but those of an admin), or the server is "
            "stopping or older than this operation"
            if request.operation.startswith("admin/")
            else "the server is stopping or older than this question, access control forbids the "
            "request, or a message exceeds a size limit"
        )
        return NoReplyError(f"no reply on {self._key(request)} although the map is there: {why}")

    def _key(self, request: Request[Any]) -> str:
        return keys.operation_key(self.map_name, request.operation)

    def _broken(self, error: Exception) -> Exception:
        if self.is_closed:
            return ClosedError("the client is closed")
        return ConnectError(f"the connection is broken: {error}")


def new_ticket() -> int:
    """Return the ticket of a request for :meth:`Connection.ask_until_done`."""
    return secrets.randbits(63) or 1


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


def is_cancelled() -> bool:
    """Return whether the running call was cancelled."""
    token = _cancellation.get()
    return token is not None and token.is_cancelled


@contextmanager
def cancellable(
    chosen: zenoh.CancellationToken | None = None,
) -> Iterator[zenoh.CancellationToken]:
    """Yield the token whose cancellation ends the requests of the block, each with an error.

    Unless one is ``chosen``, it is that of the surrounding block, where there is one.
    """
    token = chosen or _cancellation.get() or zenoh.CancellationToken()
    before = _cancellation.set(token)
    try:
        yield token
    finally:
        _cancellation.reset(before)
