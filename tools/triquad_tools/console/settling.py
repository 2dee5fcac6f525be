"""Waiting for a server: until it has taken in scans, and until it has learnt them."""

import time
from typing import TYPE_CHECKING

from triquad_tools.console.progress import progress

if TYPE_CHECKING:
    from triquad_client import Client, ServerStatus

_POLL_S = 0.5  # the server says how it is doing when it is asked, not when it changes

FLUSH_TIMEOUT_S = 120.0

_PENDING = 4


def keep_few_pending(client: "Client", published: int) -> None:
    """Call after each scan: lets 4 to 8 scans be under way, far fewer than a server queues.

    Not after every scan, for the server publishes an epoch before it answers.
    """
    if published % _PENDING == 0:
        client.flush(FLUSH_TIMEOUT_S, pending=_PENDING)


def wait_until_settled(client: "Client", limit_s: float | None = None) -> "ServerStatus":
    """The server's status once nothing is left to learn, or after ``limit_s`` seconds."""
    started = time.monotonic()
    with progress("training", limit_s) as report:
        while True:
            status = client.status()
            waited_s = time.monotonic() - started
            done_s = limit_s if status.settled and limit_s is not None else waited_s
            report(done_s, f"{status.samples_trained / 1e6:.1f} M samples, loss {status.loss:.4f}")
            if status.settled or (limit_s is not None and waited_s >= limit_s):
                return status
            time.sleep(_POLL_S)
