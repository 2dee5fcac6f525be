"""How many bytes a second each client is sent: a token bucket for each."""

import math
from collections import OrderedDict
from dataclasses import dataclass

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
    """Buckets of clients, by their names. Times are monotonic seconds.

    A rate of infinity sets no limit.
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
