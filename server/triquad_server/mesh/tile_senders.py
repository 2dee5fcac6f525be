"""Sends replies to clients that follow the mesh; one that does not read delays no other."""

import logging
import math
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from triquad_format.wire.mesh_messages import TileUpdates
from triquad_map.compiled.team import lower_priority

from triquad_server.fair_queue import Owner
from triquad_server.mesh.followers import BURST_S, Follower
from triquad_server.process.threads import NICENESS, submit

_log = logging.getLogger(__name__)

_SENDERS = 16
"""The number of replies sent at a time: clients that do not read them delay no others."""

MAX_CLIENTS = 1024
"""The number of clients that are kept; the one heard of longest ago is removed."""


@dataclass
class _Bucket:
    """The bytes that a client may be sent; negative if it was sent more."""

    tokens: float  # bytes
    at_s: float


class Bandwidth:
    """Limits the bytes per second to each client: a token bucket for each, by its name.

    Times are monotonic seconds. A rate of infinity sets no limit.
    """

    def __init__(self) -> None:
        self._buckets: OrderedDict[str, _Bucket] = OrderedDict()

    def ready_s(self, client: str, bytes_per_s: float, now_s: float) -> float:
        """Return when a client may be sent to again, monotonic seconds: now, if it may."""
        if math.isinf(bytes_per_s):
            return now_s
        tokens = self._filled(client, bytes_per_s, now_s).tokens
        return now_s if tokens > 0 else now_s + (1.0 - tokens) / bytes_per_s

    def spend(self, client: str, count: int, bytes_per_s: float, now_s: float) -> None:
        """Count bytes that are sent to a client."""
        if not math.isinf(bytes_per_s):
            self._filled(client, bytes_per_s, now_s).tokens -= count

    def _filled(self, client: str, bytes_per_s: float, now_s: float) -> _Bucket:
        most = bytes_per_s * BURST_S
        bucket = self._buckets.setdefault(client, _Bucket(most, now_s))
        self._buckets.move_to_end(client)
        bucket.tokens = min(most, bucket.tokens + bytes_per_s * (now_s - bucket.at_s))
        bucket.at_s = now_s
        if len(self._buckets) > MAX_CLIENTS:
            self._buckets.popitem(last=False)
        return bucket


class TileSenders:
    """Sends replies, on threads of its own, to each client at its permitted rate."""

    def __init__(self, on_sent: Callable[[], None]) -> None:
        """Make the senders; ``on_sent`` is called after each reply, in the thread that sent it."""
        self._on_sent = on_sent
        self._bandwidth = Bandwidth()
        self._lock = threading.Lock()
        self._sending: Counter[Owner] = Counter()  # replies that are not sent yet
        self._threads = ThreadPoolExecutor(
            _SENDERS, "tile-sender", initializer=lower_priority, initargs=(NICENESS,)
        )

    @property
    def sending(self) -> int:
        """Return the number of replies that are not sent yet."""
        with self._lock:
            return self._sending.total()

    def is_sending_to(self, follower: Follower) -> bool:
        """Return whether a reply to the same client is being sent: the next waits for it."""
        with self._lock:
            return self._sending[follower.request.owner] > 0

    def ready_s(self, follower: Follower) -> float:
        """Return when a follower's client may be sent to again, monotonic seconds: now, if it may.

        It is for one thread.
        """
        return self._bandwidth.ready_s(follower.asks.client, follower.bytes_per_s, time.monotonic())

    def send(self, follower: Follower, reply: TileUpdates) -> None:
        """Send a reply, in the background; for the thread that calls :meth:`ready_s`."""
        self._bandwidth.spend(
            follower.asks.client, len(reply.data), follower.bytes_per_s, now_s=time.monotonic()
        )
        with self._lock:
            self._sending[follower.request.owner] += 1
        submit(self._threads, self._answer, follower, reply)

    def refuse(self, follower: Follower, code: str, text: str) -> None:
        """Refuse a request, in the background."""
        submit(self._threads, follower.request.refuse, code, text)

    def close(self) -> None:
        """Send what is left, and end."""
        self._threads.shutdown()

    def _answer(self, follower: Follower, reply: TileUpdates) -> None:
        try:
            follower.request.answer(reply)
        except Exception:
            _log.exception("a reply to a follower of the mesh could not be sent")
        finally:
            with self._lock:
                self._sending -= Counter([follower.request.owner])
            self._on_sent()
