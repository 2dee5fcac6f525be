"""Publishing scans no faster than a server integrates them, and waiting until they are learnt."""

import time
from collections.abc import Sequence

from triquad_client import Client, FlushReport, ServerStatus

from triquad_tools.console.progress import progress
from triquad_tools.sensors.sweep import PosedScan

_POLL_S = 0.5  # the server says how it is doing when it is asked, not when it changes

FLUSH_TIMEOUT_S = 120.0

_PENDING = 4


def keep_few_pending(client: Client, published: int) -> None:
    """Let 4 to 8 scans be pending, far fewer than a server queues. Call after each scan.

    Not after every scan, for the server publishes an epoch before it answers.
    """
    if published % _PENDING == 0:
        client.flush(FLUSH_TIMEOUT_S, pending=_PENDING)


def publish_all(client: Client, scans: Sequence[PosedScan]) -> FlushReport:
    """Publish scans, and wait until the server has integrated all of them."""
    with progress("publishing scans", len(scans)) as report:
        for number, scan in enumerate(scans, start=1):
            client.publish_scan(scan.points, scan.world_from_sensor)
            keep_few_pending(client, number)
            report(number, f"{number} of {len(scans)} scans")
        return client.flush(FLUSH_TIMEOUT_S)


def wait_until_settled(client: Client, limit_s: float | None = None) -> ServerStatus:
    """Return the server's status once nothing is left to learn, or after ``limit_s`` seconds."""
    started = time.monotonic()
    first = client.status()
    with progress("training", first.samples_left) as report:
        while True:
            status = client.status()
            waited_s = time.monotonic() - started
            note = f"{status.samples_trained / 1e6:.1f} M samples, loss {status.loss:.4f}"
            report(first.samples_left - status.samples_left, note)
            if status.settled or (limit_s is not None and waited_s >= limit_s):
                return status
            time.sleep(_POLL_S)
