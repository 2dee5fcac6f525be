"""Publishing scans, and waiting until they are learnt."""

import time
from collections.abc import Iterable, Sequence

from triquad_client import Client, ServerStatus

from triquad_tools.console.progress import progress
from triquad_tools.recordings.recording import ScanEntry
from triquad_tools.sensors.sweep import PosedScan

_POLL_S = 0.5  # the server says how it is doing when it is asked, not when it changes

FLUSH_TIMEOUT_S = 120.0

_PENDING = 4  # scans, to twice as many, are on their way: far fewer than a server queues


def publish_all(
    client: Client,
    scans: Iterable[tuple[ScanEntry, PosedScan]],
    total: int,
    due_s: Sequence[float] = (),
    title: str = "publishing",
) -> int:
    """Publish ``total`` scans, and return how many had points, and were sent.

    Each is sent when it is due, seconds after the beginning; without times the server sets the
    pace, so that none is lost.
    """
    started_s, published = time.monotonic(), 0
    with progress(title, total) as report:
        for done, (entry, scan) in enumerate(scans, start=1):
            if due_s:
                time.sleep(max(0.0, started_s + due_s[done - 1] - time.monotonic()))
            if len(scan.points):
                pose, stamp_s = scan.world_from_sensor, entry.stamp_ns / 1e9
                client.publish_scan(
                    scan.points, pose, stamp_s, source=entry.source, no_return=scan.no_return
                )
                published += 1
                # Not after every scan, for the server publishes an epoch before it answers.
                if not due_s and published % _PENDING == 0:
                    client.flush(FLUSH_TIMEOUT_S, pending=_PENDING)
            report(done, f"{done} of {total} scans")
    return published


def wait_until_settled(client: Client, limit_s: float | None = None) -> ServerStatus:
    """Return the server's status once nothing is left to learn, or after ``limit_s`` seconds."""
    started = time.monotonic()
    first = client.status()
    # With a limit, how long all of it would take is not how long it will take.
    title = "training" if limit_s is None else f"waiting {limit_s:g} s at most for training"
    with progress(title, first.samples_left if limit_s is None else None) as report:
        while True:
            status = client.status()
            waited_s = time.monotonic() - started
            samples = f"{status.samples_trained / 1e6:.1f} M samples"
            note = f"{status.learnt_percent} % learnt, {samples}"
            report(first.samples_left - status.samples_left, note)
            if status.settled or (limit_s is not None and waited_s >= limit_s):
                return status
            time.sleep(_POLL_S)
