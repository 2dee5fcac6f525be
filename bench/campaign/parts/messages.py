"""Mutated messages on all keys of a real server."""

import threading
from concurrent.futures import ThreadPoolExecutor

import zenoh
from support import servers
from triquad_format.errors import ERROR_CODES, FormatError
from triquad_format.wire import codec, keys
from triquad_format.wire.messages import ErrorReply

from bench.campaign.mutated_messages import MutatedMessages
from bench.campaign.server_under_test import (
    expect,
    expect_honest_service,
    expect_steady_memory,
    learnt_server,
)
from bench.campaign.turn import Turn

_SENDERS = 8
_REPLY_S = 30.0
_WARM_SHARE = 5  # memory is compared with that after one part in N


def run(turn: Turn) -> None:
    """Send mutants from several threads, check every reply, then ask as an honest client."""
    with learnt_server(turn) as server, servers.raw_session(connect=server.endpoint) as session:
        senders = [_Sender(turn, session, number) for number in range(_SENDERS)]
        before = _send(turn, senders, turn.most // _WARM_SHARE, server)
        after = _send(turn, senders, turn.most, server)
        expect_steady_memory(turn, before, after)
        expect_honest_service(server.endpoint)


def _send(turn: Turn, senders: "list[_Sender]", most: int, server: servers.ServerProcess) -> int:
    """Send the given number; return the memory that the server then takes."""
    with ThreadPoolExecutor(len(senders)) as pool:
        for sent in [pool.submit(sender.send_until, most) for sender in senders]:
            sent.result()
    expect(server.process.poll() is None, f"the server ended with {server.process.returncode}")
    return server.resident_bytes


class _Sender:
    """A thread's own mutants."""

    _lock = threading.Lock()

    def __init__(self, turn: Turn, session: zenoh.Session, number: int) -> None:
        self._turn = turn
        self._peer = servers.RawPeer(session)
        self._mutants = MutatedMessages(type(turn.random)(f"{turn.seed}/{number}"))

    def send_until(self, most: int) -> None:
        while self._turn.counts["done"] < most and not self._turn.over:
            scan = self._mutants.scan()
            if scan is not None:
                self._peer.put("lidar", scan)
                self._count("scans")
            else:
                operation, payload = self._mutants.request()
                self._count(self._outcome(operation, payload))

    def _outcome(self, operation: str, payload: bytes) -> str:
        key = keys.operation_key(self._peer.map_name, operation)
        for reply in self._peer.session.get(key, payload=payload, timeout=_REPLY_S):
            if reply.ok is not None:
                return "answered"
            data = reply.err.payload.to_bytes()
            try:
                code = codec.decode(ErrorReply, data).code
            except FormatError:
                self._broke(operation, payload, f"no reply within {_REPLY_S} s ({data!r:.40})")
                return "without reply"
            if code == "internal" or code not in ERROR_CODES:
                self._broke(operation, payload, code)
            return "refused"
        self._broke(operation, payload, "no reply at all")
        return "without reply"

    def _count(self, what: str) -> None:
        with self._lock:
            self._turn.did(what)

    def _broke(self, operation: str, payload: bytes, how: str) -> None:
        with self._lock:
            self._turn.broke(f"{operation}: {how}: payload {payload[:2000].hex()}")
