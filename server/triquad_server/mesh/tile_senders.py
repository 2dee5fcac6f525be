"""Sending replies to followers: a client that does not read, or is slow, holds up no other."""

import logging
import math
import threading
import time
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from triquad_format.wire.messages import TileUpdates
from triquad_map.compiled.team import lower_priority

from triquad_server.mesh.follower import Follower
from triquad_server.threads import NICENESS

_log = logging.getLogger(__name__)

_SENDERS = 2

MAX_CLIENTS = 1024
"""Of more, those heard of longest ago are forgotten."""

BURST_S = 1.0
"""A client that asked for nothing for so long may be sent as many seconds' worth at once."""


@dataclass
class _Bucket:
    """What a client may be sent; less than nothing where it was sent more."""

    tokens: float  # bytes
    at_s: float


class Bandwidth:
    """How many bytes a second each client is sent: a token bucket for each, by its name.

    Times are monotonic seconds. A rate of infinity sets no limit.
    """

    def __init__(self) -> None:
        self._buckets: OrderedDict[str, _Bucket] = OrderedDict()

    def may_send(self, client: str, bytes_per_s: float, now_s: float) -> bool:
        """Whether it is time to send to a client again."""
        return math.isinf(bytes_per_s) or self._filled(client, bytes_per_s, now_s).tokens > 0

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
    """Sends replies, on threads of its own, to each client as fast as it may be sent to."""

    def __init__(self) -> None:
        self._bandwidth = Bandwidth()
        self._lock = threading.Lock()
        self.sending = 0  # replies that are not sent yet
        self._threads = ThreadPoolExecutor(
            _SENDERS, "tile-sender", initializer=lower_priority, initargs=(NICENESS,)
        )

    def may_send(self, follower: Follower) -> bool:
        """Whether it is time to send to a follower's client again. For one thread."""
        return self._bandwidth.may_send(
            follower.asks.client, follower.bytes_per_s, time.monotonic()
        )

    def send(self, follower: Follower, reply: TileUpdates) -> None:
        """Send a reply, in the background. For the thread that asks :meth:`may_send`."""
        self._bandwidth.spend(
            follower.asks.client, len(reply.data), follower.bytes_per_s, time.monotonic()
        )
        with self._lock:
            self.sending += 1
        self._threads.submit(self._answer, follower, reply)

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
                self.sending -= 1
