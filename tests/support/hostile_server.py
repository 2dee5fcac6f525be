"""A server that answers in the right form, but for what a lie changes."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any

import msgpack
import numpy as np
import zenoh
from support.honest_replies import honest_reply
from support.operations import OPERATIONS
from support.servers import MAP, raw_session
from triquad_format.wire import (
    codec,
    keys,
    messages,
    metrics_messages,
    query_messages,
    source_messages,
)
from triquad_tools.demo.server import free_endpoint

Body = dict[str, Any]
"""A message as a msgpack map: what an encoder of messages would refuse, it can hold."""

_KINDS = {
    kind.__name__: kind
    for module in (messages, query_messages, source_messages, metrics_messages)
    for kind in vars(module).values()
    if isinstance(kind, type) and issubclass(kind, codec.Message)
}


@dataclass
class HostileServer:
    """Answers each question with what ``lie`` makes of the honest reply's bytes."""

    endpoint: str
    lie: Callable[[str, bytes], bytes | zenoh.ZBytes] = lambda _, honest: honest
    refusal: bytes | None = None  # is the reply instead, as an error
    answered: list[str] = field(default_factory=list)  # operations
    sent_bytes: int = 0

    def answer(self, operation: str, query: zenoh.Query) -> None:
        assert query.payload is not None
        payload = query.payload.to_bytes()
        kind = _KINDS[msgpack.unpackb(payload)["kind"]]
        self.answered.append(operation)
        if self.refusal is not None:
            query.reply_err(self.refusal)
            return
        reply = self.lie(operation, codec.encode(honest_reply(codec.decode(kind, payload))))
        self.sent_bytes += len(reply)
        query.reply(query.key_expr, reply)


def told(operation: str, change: Callable[[Body], object]) -> Callable[[str, bytes], bytes]:
    """The lie that ``change`` makes of the body of the replies of an operation."""

    def lie(asked: str, honest: bytes) -> bytes:
        if asked != operation:
            return honest
        body: Body = msgpack.unpackb(honest)
        change(body)
        return msgpack.packb(body)

    return lie


def packed(values: object, dtype: str = "<f4") -> Body:
    """An array as messages have it."""
    return codec.pack_array(np.asarray(values, dtype))


@contextmanager
def hostile_server() -> Iterator[HostileServer]:
    """A router that claims to have the default map, and answers all its operations."""
    server = HostileServer(free_endpoint())
    with raw_session("router", listen=server.endpoint) as session, ExitStack() as declared:
        for operation in OPERATIONS:
            key = keys.operation_key(MAP, operation)

            def reply(query: zenoh.Query, operation: str = operation) -> None:
                with query:
                    server.answer(operation, query)

            queryable = session.declare_queryable(key, reply)
            declared.callback(queryable.undeclare)
        token = session.liveliness().declare_token(keys.alive_key(MAP, "x"))
        declared.callback(token.undeclare)
        yield server
