"""Threads that send replies to followers: a client that does not read holds up no other."""

import logging
import threading
import time
from concurrent.futures import ThreadPoolExecutor

from triquad_format.wire.messages import TileUpdates
from triquad_map.compiled.team import lower_priority

from triquad_server.mesh.bandwidth import Bandwidth
from triquad_server.mesh.follower import Follower
from triquad_server.threads import NICENESS

_log = logging.getLogger(__name__)

_SENDERS = 2


class TileSenders:
    """Sends replies to followers, to each client as fast as it may be sent to."""

    def __init__(self) -> None:
        self._bandwidth = Bandwidth()
        self._lock = threading.Lock()
        self._sending = 0
        self._threads = ThreadPoolExecutor(
            _SENDERS, "tile-sender", initializer=lower_priority, initargs=(NICENESS,)
        )

    @property
    def sending(self) -> int:
        """Replies that are not sent yet."""
        return self._sending

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
            self._sending += 1
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
                self._sending -= 1
