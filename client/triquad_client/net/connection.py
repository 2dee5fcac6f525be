"""The Zenoh session of a client, requests over it, and the driver that makes them."""

import json
import weakref
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import zenoh
from triquad_format.errors import FormatError, InvalidInputError, RefusedError, WireError
from triquad_format.printable import printable
from triquad_format.wire import codec, keys
from triquad_format.wire.codec import Message
from triquad_format.wire.endpoints import full_endpoint
from triquad_format.wire.messages import ErrorReply
from triquad_format.wire.origin import RequestOrigin
from triquad_format.wire.reply import MAX_COUNT, check_answers
from triquad_format.wire.zenoh_config import QUIET, fill, put

from triquad_client import checks
from triquad_client.errors import (
    BadReplyError,
    ClosedError,
    ConnectError,
    NoReplyError,
    RequestTimeoutError,
    UnknownMapError,
)
from triquad_client.net.call import Ask, Batch, BlockingDriver, ReplyT, exchange
from triquad_client.net.diagnosis import why_no_link

_HERE = "127.0.0.1"
_LIVELINESS_TIMEOUT_S = 3.0
_MAX_REASON = 2_000  # characters of why a request was refused

_OF_CLIENTS: Mapping[str, Any] = {
    "mode": "client",
    "connect/timeout_ms": 0,  # one attempt, not retries
    "transport/link/rx/max_message_size": codec.MAX_MESSAGE_BYTES,
}
"""The settings of Zenoh for a client, besides what a file says."""

Receiver: TypeAlias = Any
"""``None``, or a ``zenoh.handlers.Callback[zenoh.Reply]``: the overloads of Zenoh take no union."""


class Connection:
    """An open session, bound to one map. Safe for use by several threads."""

    def __init__(
        self, session: zenoh.Session, map_name: str, timeout_s: float, *, max_download_bytes: int
    ) -> None:
        self._session = session
        self._id = str(session.info.zid())
        # A session that a program forgot is closed before Python ends: Zenoh's threads must not
        # come back into an interpreter that is no longer there.
        self._close = weakref.finalize(self, session.close)
        self.map_name = map_name
        self.timeout_s = timeout_s
        self.max_download_bytes = max_download_bytes  # of a map file, or the mesh of a box

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

    def send(
        self,
        ask: Ask[Any],
        receiver: Receiver = None,
        cancellation: zenoh.CancellationToken | None = None,
    ) -> Iterable[zenoh.Reply]:
        """Send a request; its reply comes from what is returned, or to ``receiver``.

        Raises:
            ClosedError: the session was closed.
            ConnectError: it is broken.
        """
        timeout_s = self._timeout_s(ask)
        try:
            replies: Iterable[zenoh.Reply] = self._session.get(
                self._key(ask),
                receiver,
                payload=codec.encode(ask.message),
                encoding=keys.encoding(type(ask.message)),
                attachment=codec.encode(RequestOrigin(self._id, timeout_s)),
                timeout=timeout_s,
                priority=zenoh.Priority.BACKGROUND if ask.background else zenoh.Priority.DATA,
                congestion_control=zenoh.CongestionControl.BLOCK,
                consolidation=zenoh.ConsolidationMode.NONE,
                cancellation_token=cancellation,
            )
        except zenoh.ZError as error:
            raise self._broken(error) from error
        return replies

    def read(self, ask: Ask[ReplyT], reply: zenoh.Reply) -> ReplyT:
        """Return the message of a reply. Nothing of it is used before all of it was checked.

        Raises:
            RefusedError: the server refused.
            RequestTimeoutError: there was no reply in time.
            BadReplyError: it cannot be decoded, or is no answer to what was asked.
        """
        try:
            if reply.ok is not None:
                answer = codec.decode(ask.kind, reply.ok.payload.to_bytes())
                check_answers(ask.message, answer)
                return answer
            payload = b"" if reply.err is None else reply.err.payload.to_bytes()
            if payload == b"Timeout":
                raise RequestTimeoutError(
                    f"no reply on {self._key(ask)} within {self._timeout_s(ask):g} s"
                )
            reason = codec.decode(ErrorReply, payload)
        except WireError as error:
            raise BadReplyError(f"reply on {self._key(ask)}: {error}") from error
        raise RefusedError(
            printable(reason.code, _MAX_REASON), printable(reason.message, _MAX_REASON)
        )

    def no_reply_error(self, ask: Ask[Any], available: list[str]) -> Exception:
        """Return the error for a request that got no reply, where there are these maps."""
        if self.is_closed:
            return closed_error()
        info = self._session.info
        if not (info.routers_zid() or info.peers_zid()):
            return ConnectError(
                "the link to the server is down; it is set up again once the server is back"
            )
        if self.map_name not in available:
            return UnknownMapError(self.map_name, available)
        if ask.operation.startswith("admin/"):
            return NoReplyError(
                f"no reply on {self._key(ask)} although the map is there: access control forbids "
                "it (without roles to all but programs of the server's machine that connect to "
                "127.0.0.1, with roles to all but those of an admin), or the server is stopping or "
                "older than this operation"
            )
        return NoReplyError(
            f"no reply on {self._key(ask)} although the map is there: the server is stopping "
            "or older than this question, access control forbids the request, or a message "
            "exceeds a size limit"
        )

    def put(self, key: str, message: Message) -> None:
        """Publish a message; blocks where the network is slower than the publisher.

        Raises as :meth:`send`.
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

    def look_for_maps(
        self,
        receiver: Receiver = None,
        cancellation: zenoh.CancellationToken | None = None,
        map_name: str = "*",
    ) -> Iterable[zenoh.Reply]:
        """Ask all servers in reach for their maps, or for one of this name.

        Replies and errors are as of :meth:`send`.
        """
        try:
            replies: Iterable[zenoh.Reply] = self._session.liveliness().get(
                keys.alive_key(map_name, "*"),
                receiver,
                timeout=_LIVELINESS_TIMEOUT_S,
                cancellation_token=cancellation,
            )
        except zenoh.ZError as error:
            raise self._broken(error) from error
        return replies

    def _key(self, ask: Ask[Any]) -> str:
        return keys.operation_key(self.map_name, ask.operation)

    def _timeout_s(self, ask: Ask[Any]) -> float:
        return max(self.timeout_s, ask.min_timeout_s) + ask.server_wait_s

    def _broken(self, error: Exception) -> Exception:
        if self.is_closed:
            return closed_error()
        return ConnectError(f"the connection is broken: {error}")


class RemoteDriver(BlockingDriver):
    """Runs calls over a connection, in the threads that make them."""

    def __init__(
        self, connection: Connection, cancellation: zenoh.CancellationToken | None = None
    ) -> None:
        """Run calls; once ``cancellation`` is cancelled, each ends with an error."""
        self._connection = connection
        self._cancellation = cancellation

    def maps(self) -> list[str]:
        """Return names of the maps of all servers that can be reached."""
        return map_names(self._connection.look_for_maps(cancellation=self._cancellation))

    async def _replies(self, batch: Batch) -> list[Any]:
        return await exchange(batch, self._send, self._receive)

    async def _send(self, ask: Ask[Any]) -> Iterable[zenoh.Reply]:
        return self._connection.send(ask, cancellation=self._cancellation)

    async def _receive(self, ask: Ask[Any], replies: Iterable[zenoh.Reply]) -> Any:
        for reply in replies:
            return self._connection.read(ask, reply)
        raise self._connection.no_reply_error(ask, self.maps())


def closed_error() -> ClosedError:
    """Return the error for what is asked of a closed client."""
    return ClosedError("the client is closed")


def map_names(replies: Iterable[zenoh.Reply]) -> list[str]:
    """Return the maps that the replies to :meth:`Connection.look_for_maps` name."""
    names = {str(reply.ok.key_expr).split("/")[1] for reply in replies if reply.ok}
    return sorted(filter(keys.is_name, names))


def open_connection(
    endpoint: str | None,
    map_name: str,
    timeout_s: float,
    config: str | Path | None,
    *,
    max_download_bytes: int,
) -> Connection:
    """Return a connection to a server; arguments and errors as of ``triquad_client.connect``."""
    timeout_s = checks.within("timeout_s", timeout_s, checks.LONGEST_S, least=0.0)
    most = checks.count("max_download_bytes", max_download_bytes, MAX_COUNT)
    where = f"with {config}" if endpoint is None and config else f"to {endpoint or _HERE}"
    try:
        keys.check_name("map", map_name)
        configured = _configuration(endpoint, timeout_s, config)
    except FormatError as error:
        raise InvalidInputError(str(error)) from error
    except zenoh.ZError as error:
        raise ConnectError(f"cannot connect {where}: {_reason(error)}") from error
    try:
        session = zenoh.open(configured)
    except zenoh.ZError as error:
        why = why_no_link(configured, timeout_s) or (
            f"{_reason(error)} Start triquad-server there, or check the endpoint and the "
            "credentials."
        )
        raise ConnectError(f"cannot connect {where}: {why}") from error
    connection = Connection(session, map_name, timeout_s, max_download_bytes=most)
    try:
        # Asked for by name first: there may be any number of others.
        if not map_names(connection.look_for_maps(map_name=map_name)):
            raise UnknownMapError(map_name, map_names(connection.look_for_maps()))
    except BaseException:
        connection.close()
        raise
    return connection


def _configuration(endpoint: str | None, timeout_s: float, file: str | Path | None) -> zenoh.Config:
    config = zenoh.Config() if file is None else _read_configuration(file)
    fill(config, {**QUIET, **_OF_CLIENTS}, unset=zenoh.Config())
    put(config, {"transport/unicast/open_timeout": int(timeout_s * 1000)})
    if endpoint is not None or not json.loads(config.get_json("connect/endpoints")):
        only_tls = json.loads(config.get_json("transport/link/protocols")) == ["tls"]
        protocol = "tls" if only_tls else "tcp"
        full = full_endpoint(_HERE if endpoint is None else endpoint, protocol)
        put(config, {"connect/endpoints": [full]})
    return config


def _read_configuration(file: str | Path) -> zenoh.Config:
    try:
        config: zenoh.Config = zenoh.Config.from_file(str(file))
    except zenoh.ZError as error:
        raise ConnectError(f"Zenoh configuration {file}: {_reason(error)}") from error
    return config


def _reason(error: zenoh.ZError) -> str:
    """Return what Zenoh says, on one line, without where in Zenoh it happened."""
    return " ".join(str(error).split(" at /", 1)[0].split())
