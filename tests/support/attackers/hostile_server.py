"""A server that changes the replies of a real one on their way to the client."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgpack
import numpy as np
import triquad_client
import zenoh
from support import servers
from support.operations import OPERATIONS
from triquad_format.wire import codec, keys

Body = dict[str, Any]
"""A message as a msgpack map: what an encoder of messages would refuse, it can hold."""


@dataclass
class HostileServer:
    """Answers each question with what ``lie`` makes of the bytes of the real server's reply."""

    endpoint: str
    real: zenoh.Session  # of a client of the real server
    lie: Callable[[str, bytes], bytes] = lambda _, honest: honest
    refusal: bytes | None = None  # is the reply instead, as an error

    def answer(self, operation: str, query: zenoh.Query) -> None:
        if self.refusal is not None:
            query.reply_err(self.refusal)
            return
        (honest,) = self.real.get(
            str(query.key_expr),
            payload=query.payload,
            attachment=query.attachment,
            timeout=servers.WAIT_S,
        )
        if honest.ok is None:
            query.reply_err(honest.err.payload)
        else:
            query.reply(query.key_expr, self.lie(operation, honest.ok.payload.to_bytes()))


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
    """A router before a service that has learnt a sphere: all questions and scans pass it."""
    with (
        TemporaryDirectory() as store,
        servers.running_service(servers.LOGGED, store=Path(store)) as endpoint,
        servers.raw_session(connect=endpoint) as real,
        ExitStack() as declared,
    ):
        with triquad_client.connect(endpoint) as client:
            servers.learn_all(client)
        server = HostileServer(servers.free_endpoint(), real)
        session = declared.enter_context(servers.raw_session("router", listen=server.endpoint))
        for operation in OPERATIONS:

            def reply(query: zenoh.Query, operation: str = operation) -> None:
                with query:
                    server.answer(operation, query)

            key = keys.operation_key(servers.MAP, operation)
            declared.callback(session.declare_queryable(key, reply).undeclare)

        def forward(sample: zenoh.Sample) -> None:
            real.put(str(sample.key_expr), sample.payload)

        scans = session.declare_subscriber(keys.all_scans_key(servers.MAP), forward)
        declared.callback(scans.undeclare)
        token = session.liveliness().declare_token(keys.alive_key(servers.MAP, "x"))
        declared.callback(token.undeclare)
        yield server
