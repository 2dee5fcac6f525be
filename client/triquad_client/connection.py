"""The Zenoh session of a client, and requests over it."""

import json
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Generic, TypeVar

import zenoh
from triquad_format import keys, wire
from triquad_format.errors import FormatError, WireError
from triquad_format.messages import ErrorReply
from triquad_format.wire import Message

from triquad_client.errors import (
    BadReplyError,
    ClosedError,
    ConnectError,
    InvalidInputError,
    NoReplyError,
    RefusedError,
    RequestTimeoutError,
    UnknownMapError,
)

PARTS_IN_FLIGHT = 4
"""Requests of one call that wait for their replies at the same time."""

_LIVELINESS_TIMEOUT_S = 3.0

_ATTEMPTS = 3

ItemT = TypeVar("ItemT")
ReplyT = TypeVar("ReplyT", bound=Message)
ResultT = TypeVar("ResultT")


class Pending(Generic[ReplyT]):
    """A request on its way."""

    def __init__(
        self,
        connection: "Connection",
        replies: Iterable[zenoh.Reply],
        kind: type[ReplyT],
        key: str,
        timeout_s: float,
    ) -> None:
        self._connection = connection
        self._replies = replies
        self._kind = kind
        self._key = key
        self._timeout_s = timeout_s

    def result(self) -> ReplyT:
        """The reply, once it is there.

        Raises:
            RefusedError: the server refused.
            RequestTimeoutError: no reply came in time.
            UnknownMapError: there is no such map.
            NoReplyError: there is, but no reply came.
            BadReplyError: the reply cannot be decoded.
        """
        for reply in self._replies:
            if reply.ok is not None:
                return self._decode(self._kind, reply.ok.payload.to_bytes())
            if reply.err is not None:
                raise self._refusal(reply.err)
        raise self._connection.explain_silence(self._key)

    def _refusal(self, error: zenoh.ReplyError) -> Exception:
        payload = error.payload.to_bytes()
        if payload == b"Timeout":
            return RequestTimeoutError(f"no reply on {self._key} within {self._timeout_s:g} s")
        reason = self._decode(ErrorReply, payload)
        return RefusedError(reason.code, reason.message)

    def _decode(self, kind: type[ItemT], payload: bytes) -> ItemT:
        try:
            return wire.decode(kind, payload)  # type: ignore[type-var]
        except WireError as error:
            raise BadReplyError(f"reply on {self._key}: {error}") from error


class Connection:
    """An open session, bound to one map. Safe for use by several threads."""

    def __init__(self, session: zenoh.Session, map_name: str, timeout_s: float) -> None:
        self._session = session
        self.map_name = map_name
        self.timeout_s = timeout_s

    def close(self) -> None:
        """Close the session; closing twice does no harm."""
        self._session.close()

    def send(
        self,
        operation: str,
        request: Message,
        kind: type[ReplyT],
        *,
        background: bool = False,
        timeout_s: float | None = None,
    ) -> Pending[ReplyT]:
        """Send a request; its reply is a ``kind``.

        Bulky requests go in the ``background``: a reply has the priority of its request, and a
        slow reader of large replies must not hold up the distance queries of others.
        """
        key = keys.operation_key(self.map_name, operation)
        wait_s = self.timeout_s if timeout_s is None else timeout_s
        priority = zenoh.Priority.BACKGROUND if background else zenoh.Priority.DATA
        try:
            replies = self._session.get(
                key,
                payload=wire.encode(request),
                encoding=keys.encoding(type(request)),
                timeout=wait_s,
                priority=priority,
                congestion_control=zenoh.CongestionControl.BLOCK,
                consolidation=zenoh.ConsolidationMode.NONE,
            )
        except zenoh.ZError as error:
            raise self._broken(error) from error
        return Pending(self, replies, kind, key, wait_s)

    def ask(
        self,
        operation: str,
        request: Message,
        kind: type[ReplyT],
        *,
        background: bool = False,
        timeout_s: float | None = None,
    ) -> ReplyT:
        """Send a request and wait for its reply; raises as :meth:`Pending.result`."""
        pending = self.send(operation, request, kind, background=background, timeout_s=timeout_s)
        return pending.result()

    def put(self, key: str, message: Message) -> None:
        """Publish a message; blocks where the network is slower than the publisher."""
        try:
            self._session.put(
                key,
                wire.encode(message),
                encoding=keys.encoding(type(message)),
                # The default drops large samples even on an idle network.
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.DATA,
            )
        except zenoh.ZError as error:
            raise self._broken(error) from error

    def maps(self) -> list[str]:
        """Names of the maps of all servers that can be reached."""
        try:
            replies = self._session.liveliness().get(
                keys.alive_key("*", "*"), timeout=_LIVELINESS_TIMEOUT_S
            )
        except zenoh.ZError as error:
            raise self._broken(error) from error
        names = {str(reply.ok.key_expr).split("/")[1] for reply in replies if reply.ok}
        return sorted(names)

    def explain_silence(self, key: str) -> Exception:
        """The error for a request that got no reply."""
        available = self.maps()
        if self.map_name not in available:
            return UnknownMapError(self.map_name, available)
        return NoReplyError(
            f"no reply on {key} although the map is there: the server is stopping, access "
            "control forbids the request, or a message exceeds a size limit",
        )

    def _broken(self, error: Exception) -> Exception:
        if self._session.is_closed():
            return ClosedError("the client is closed")
        return ConnectError(f"the connection is broken: {error}")


def open_connection(
    endpoint: str,
    map_name: str,
    timeout_s: float,
    config: Path | None,
) -> Connection:
    """A connection to the server at ``endpoint`` that has the map ``map_name``.

    Raises:
        ConnectError: nothing listens there, or it does not let us in.
        UnknownMapError: there is no such map.
        InvalidInputError: there cannot be a map of this name.
    """
    try:
        keys.check_name("map", map_name)
    except FormatError as error:
        raise InvalidInputError(str(error)) from error
    try:
        session = zenoh.open(_configuration(endpoint, timeout_s, config))
    except zenoh.ZError as error:
        reason = str(error).split(" at /", 1)[0].strip()
        raise ConnectError(
            f"cannot connect to {endpoint}: {reason} Start triquad-server there, or check the "
            "endpoint and its credentials.",
        ) from error
    connection = Connection(session, map_name, timeout_s)
    try:
        available = connection.maps()
        if map_name not in available:
            raise UnknownMapError(map_name, available)
    except BaseException:
        connection.close()
        raise
    return connection


def in_flight(
    send: Callable[[ItemT], Pending[ReplyT]],
    items: Iterable[ItemT],
) -> Iterator[ReplyT]:
    """The replies for ``items`` in their order, a few requests being under way at a time."""
    waiting: deque[Pending[ReplyT]] = deque()
    for item in items:
        waiting.append(send(item))
        if len(waiting) >= PARTS_IN_FLIGHT:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()


def retried(code: str, ask: Callable[[], ResultT]) -> ResultT:
    """What ``ask`` returns; where the server refuses with ``code``, it is asked a few times anew.

    For questions of several requests, which the server can forget while they are under way.
    """
    for _ in range(_ATTEMPTS - 1):
        try:
            return ask()
        except RefusedError as error:
            if error.code != code:
                raise
    return ask()


def _configuration(endpoint: str, timeout_s: float, file: Path | None) -> zenoh.Config:
    if file is not None:
        config: zenoh.Config = zenoh.Config.from_file(str(file))
    else:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/timeout_ms", "0")  # one attempt, not retries
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("transport/shared_memory/enabled", "false")
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("transport/unicast/open_timeout", str(int(timeout_s * 1000)))
    return config
