"""The queue of scans that wait for the mapper."""

import threading
import time
from collections import Counter
from collections.abc import Collection
from typing import NamedTuple

from triquad_format.wire.messages import Scan

from triquad_server.fair_queue import FairQueue, Owner
from triquad_server.intake.rays import ScanRays
from triquad_server.intake.source_ledger import SourceLedger

MAX_SOURCES_WAITING = 64
"""The number of sources that may each have the full number of scans wait; more share that."""

_BEHIND = 0.25
"""A source falls behind if more than this share of its limit waits."""

_PRESSED = 0.5
"""Questions give way to scans once more than this share of a source's limit waits."""

_GIVE_WAY_S = 0.05
"""Each question waits this many seconds at most: it is late then, but scans that do not fit in the
queue are lost."""

_MAX_BYTES = 100_000_000
"""The bytes of the scans of all sources that wait; of the source that has most, the oldest goes."""

_SCAN_BYTES = 2_000  # memory of a scan in addition to its points


class _WaitingScan(NamedTuple):
    scan: Scan
    arrived_s: float  # monotonic


class ScanQueue:
    """Keeps the newest scans of each source that wait; sources take turns.

    Where there are too many, the oldest is pushed out and counted: of a source that has too many,
    or of the one that has most.
    """

    def __init__(self, limit: int, limit_bytes: int = _MAX_BYTES) -> None:
        """Let at most ``limit`` scans of each source wait, and ``limit_bytes`` of all together."""
        self.limit = limit
        self.ledger = SourceLedger()
        self.dropped: Counter[str] = Counter()  # scans that are not in the map, by reason
        self.points_dropped: Counter[str] = Counter()  # of scans that are in the map, by reason
        self.received_bytes = 0  # of all messages of scans that arrived
        self._taken = threading.Condition()
        self._scans: FairQueue[_WaitingScan] = FairQueue(
            limit * MAX_SOURCES_WAITING, limit_bytes, limit, newest_go=False
        )
        self._in_hand = False

    def __len__(self) -> int:
        return len(self._scans) + self._in_hand

    def put(self, scan: Scan) -> None:
        """Add a scan, unless its sequence or stamp refuses it."""
        with self._taken:
            reason = self.ledger.arrive(scan)
            if reason is not None:
                self.dropped[reason] += 1
                return
            waiting = _WaitingScan(scan, time.monotonic())
            for pushed_out in self._scans.put(Owner(scan.source), waiting, _bytes_of(scan)):
                self.ledger.push_out(pushed_out.scan)

    def refuse(self, scan: Scan, reason: str, text: str) -> None:
        """Record that a scan that arrived is not queued."""
        with self._taken:
            backwards = self.ledger.arrive(scan)
            if backwards is None:
                self.ledger.refuse(scan, text)
            self.dropped[backwards or reason] += 1

    def receive(self, nbytes: int) -> None:
        """Count the bytes of a message that arrived."""
        with self._taken:
            self.received_bytes += nbytes

    def drop(self, reason: str) -> None:
        """Count a scan that is not in the map; reasons are words of the program."""
        with self._taken:
            self.dropped[reason] += 1

    def take(self, passed_over: Collection[str] = ()) -> Scan | None:
        """Return the oldest scan of the next source, not of one that is ``passed_over``.

        Sources that fall behind are not passed over. The scan counts as waiting until the next
        one is requested.
        """
        with self._taken:
            waiting = self._scans.take(
                lambda waiting: (
                    waiting.scan.source not in passed_over
                    or self._falls_behind(waiting.scan.source)
                )
            )
            self._in_hand = waiting is not None
            self._taken.notify_all()
            return None if waiting is None else waiting.scan

    def taken(self, scan: Scan, rays: ScanRays) -> None:
        """Record that a scan is in the map; ``rays`` are what of it is used."""
        with self._taken:
            self.points_dropped.update(rays.points_dropped)
        self.ledger.take(scan)

    def reject(self, scan: Scan, reason: str, text: str) -> None:
        """Record that the map refused a scan that was taken."""
        self.drop(reason)
        self.ledger.refuse(scan, text)

    def give_way(self, waited_s: float = 0.0) -> None:
        """Return once no source is about to lose scans, or after a moment.

        Sources whose oldest scan has waited for less than ``waited_s`` do not count: one that
        floods loses most scans whatever gives way, and none of them waits for long.
        """
        with self._taken:
            self._taken.wait_for(lambda: not self._is_pressed(waited_s), _GIVE_WAY_S)

    def _is_pressed(self, waited_s: float) -> bool:
        before_s = time.monotonic() - waited_s
        return any(
            count > _PRESSED * self.limit and waiting.arrived_s <= before_s
            for waiting, count in self._scans.oldest()
        )

    def _falls_behind(self, source: str) -> bool:
        return self._scans.count(source) > _BEHIND * self.limit


def _bytes_of(scan: Scan) -> int:
    return (
        _SCAN_BYTES + scan.points.nbytes + (0 if scan.no_return is None else scan.no_return.nbytes)
    )
