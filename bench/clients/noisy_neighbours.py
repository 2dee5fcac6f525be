"""Clients that want more than their share, as processes: greedy, not reading, flooding.

Each is on the network until its ``with`` statement ends. They speak the wire protocol by hand, to
do what the client never would.
"""

import secrets
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import zenoh
from triquad_format.wire import codec, keys
from triquad_format.wire.limits import MAX_SEARCHES
from triquad_format.wire.messages import RequestOrigin, Scan
from triquad_format.wire.query_messages import DistanceRequest, SegmentsRequest
from triquad_format.wire.zenoh_config import QUIET, put

FLOOD_HZ = 650.0
_GREEDY_AT_ONCE = 300
_GREEDY_EVERY_S = 5.0
_UNREAD = 64
_FREEZES_FOR_S = 6.0  # by then, Zenoh has closed the link
_TIMEOUT_S = 60.0


@contextmanager
def neighbour(kind: str, endpoint: str, map_name: str) -> Iterator["subprocess.Popen[str]"]:
    """Yield a process of a ``kind`` of ``KINDS``, once it has begun; it is killed in the end."""
    command = [sys.executable, "-m", __name__, kind, endpoint, map_name]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            process.stdout.readline()
            yield process
        finally:
            process.kill()


@contextmanager
def frozen_neighbours(endpoint: str, map_name: str) -> Iterator[None]:
    """Run process after process that asks for much and is frozen before it has read any of it."""
    stop = threading.Event()

    def freeze_again_and_again() -> None:
        while not stop.is_set():
            with neighbour("unread", endpoint, map_name) as process:
                process.send_signal(signal.SIGSTOP)
                stop.wait(_FREEZES_FOR_S)

    thread = threading.Thread(target=freeze_again_and_again)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def be_greedy(session: zenoh.Session, map_name: str) -> None:
    """Ask for 20,000 distances 300 times every few seconds, as a new client session each time."""
    request = codec.encode(_distances())
    _say_begun()
    while True:
        again_s = time.monotonic() + _GREEDY_EVERY_S
        asked = [
            _ask(session, map_name, keys.DISTANCE, request, name=secrets.token_hex(16))
            for _ in range(_GREEDY_AT_ONCE)
        ]
        for replies in asked:
            for _ in replies:
                pass
        time.sleep(max(0.0, again_s - time.monotonic()))


def leave_unread(session: zenoh.Session, map_name: str) -> None:
    """Ask for many distances; the parent freezes this process before the replies come."""
    _ask_and_sleep(session, map_name, keys.DISTANCE, codec.encode(_distances()))


def leave_segments(session: zenoh.Session, map_name: str) -> None:
    """Ask for long segments; then sleep until the parent ends this process."""
    rng = np.random.default_rng(0)
    starts = rng.uniform((-8, -8, -1), (8, 8, 2), (800, 3)).astype(np.float32)
    ends = starts + rng.normal(0, 3, starts.shape).astype(np.float32)
    request = SegmentsRequest(np.zeros(3), starts, ends, 0.3, 5.0, 0)
    _ask_and_sleep(session, map_name, keys.SEGMENTS, codec.encode(request))


def flood(session: zenoh.Session, map_name: str) -> None:
    """Publish valid scans of a few points, 650 a second."""
    points = np.random.default_rng(0).normal(0, 4, (20, 3)).astype(np.float32)
    number = secrets.randbits(62)
    _say_begun()
    started, sequence = time.monotonic(), 0
    while True:
        time.sleep(max(0.0, started + sequence / FLOOD_HZ - time.monotonic()))
        scan = Scan(points, np.eye(4), time.time_ns(), "flood", number, sequence)
        session.put(
            keys.scan_key(map_name, "flood"),
            codec.encode(scan),
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        sequence += 1


KINDS = {
    "greedy": be_greedy,
    "unread": leave_unread,
    "segments": leave_segments,
    "flood": flood,
}


def _distances() -> DistanceRequest:
    points = np.random.default_rng(0).uniform((-30, -8, -1), (30, 8, 4), (MAX_SEARCHES, 3))
    return DistanceRequest(np.zeros(3), points.astype(np.float32), 5.0, False, True, 0)


def _ask_and_sleep(session: zenoh.Session, map_name: str, operation: str, payload: bytes) -> None:
    asked = [_ask(session, map_name, operation, payload) for _ in range(_UNREAD)]
    _say_begun()
    time.sleep(_TIMEOUT_S)
    del asked


def _ask(
    session: zenoh.Session, map_name: str, operation: str, payload: bytes, name: str | None = None
) -> Iterable[zenoh.Reply]:
    """Ask in the name of a session, its own by default; return where replies come."""
    origin = RequestOrigin(name or str(session.info.zid()), _TIMEOUT_S)
    replies: Iterable[zenoh.Reply] = session.get(
        keys.operation_key(map_name, operation),
        payload=payload,
        attachment=codec.encode(origin),
        timeout=_TIMEOUT_S,
        congestion_control=zenoh.CongestionControl.BLOCK,
    )
    return replies


def _say_begun() -> None:
    sys.stdout.write("begun\n")
    sys.stdout.flush()


def main(argv: Sequence[str]) -> None:
    """Be a neighbour; ``argv`` is its kind, the endpoint and the map."""
    kind, endpoint, map_name = argv
    config = zenoh.Config()
    put(config, {**QUIET, "mode": "client", "connect/endpoints": [endpoint]})
    with zenoh.open(config) as session:
        KINDS[kind](session, map_name)


if __name__ == "__main__":
    main(sys.argv[1:])
