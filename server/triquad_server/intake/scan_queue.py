"""The queue of scans that wait for the map."""

import threading
from collections.abc import Collection

from triquad_format.wire.messages import Scan

from triquad_server.counter import Counter
from triquad_server.fair_queue import FairQueue, Owner
from triquad_server.intake.source_ledger import SourceLedger

MAX_SOURCES_WAITING = 64
"""Sources that may each have as many scans wait as one may; more share that."""

_BEHIND = 0.25
"""A source falls behind of whose scans more than this share of its limit wait."""

_SCAN_BYTES = 2_000  # that a scan takes beside its points


class ScanQueue:
    """The newest scans of each source that wait; sources take turns.

    Where there are too many, the oldest is pushed out and counted: of a source that has too many,
    or of the one that has most.
    """

    def __init__(self, limit: int, limit_bytes: int = 2**40) -> None:
        """At most ``limit`` scans of each source wait, and ``limit_bytes`` of all together."""
        self.limit = limit
        self.limit_bytes = limit_bytes
        self.ledger = SourceLedger()
        self.dropped = Counter()  # scans that are not in the map, by reason
        self.received_bytes = 0  # of all messages of scans that arrived
        self._lock = threading.Lock()
        self._scans: FairQueue[Scan] = FairQueue(limit * MAX_SOURCES_WAITING, limit_bytes)
        self._in_hand = False
        self._holds = False  # more scans of a source than the limit

    def __len__(self) -> int:
        return len(self._scans) + self._in_hand

    @property
    def bytes_waiting(self) -> int:
        """Bytes of the scans that wait."""
        return self._scans.nbytes

    def put(self, scan: Scan) -> None:
        """Add a scan, unless its sequence or stamp refuses it."""
        with self._lock:
            reason = self.ledger.arrive(scan)
            if reason is not None:
                self.dropped.add(reason)
                return
            owner = Owner(scan.source)
            self._scans.put(owner, scan, _bytes_of(scan))
            if self._scans.count(owner) > self.limit and not self._holds:
                self.ledger.push_out(self._scans.drop_oldest(owner))
            for pushed_out in self._scans.excess(newest=False):
                self.ledger.push_out(pushed_out)

    def hold(self) -> None:
        """Let as many scans of a source wait as there are bytes for, until few wait again.

        That is for a server which takes none in yet.
        """
        self._holds = True

    def refuse(self, scan: Scan, reason: str, text: str) -> None:
        """Account for a scan that arrived but is not let in."""
        with self._lock:
            backwards = self.ledger.arrive(scan)
            if backwards is None:
                self.ledger.turn_away(scan, text)
            self.dropped.add(backwards or reason)

    def take(self, passed_over: Collection[str] = ()) -> Scan | None:
        """The oldest scan of the next source, not of one that is ``passed_over``.

        Of a source that falls behind it may be, nevertheless. It counts as waiting until another
        is asked for.
        """
        with self._lock:
            self._holds = self._holds and len(self._scans) > self.limit
            scan = self._scans.take(
                lambda scan: scan.source not in passed_over or self._falls_behind(scan.source)
            )
            self._in_hand = scan is not None
            return scan

    def pressure(self) -> float:
        """How near a source is to losing scans: 0 while half as many wait as may, 1: it does."""
        with self._lock:
            share = self._scans.most() / self.limit
        return min(1.0, max(0.0, 2.0 * share - 1.0))

    def _falls_behind(self, source: str) -> bool:
        return self._scans.count(Owner(source)) > _BEHIND * self.limit


def _bytes_of(scan: Scan) -> int:
    return (
        _SCAN_BYTES + scan.points.nbytes + (0 if scan.no_return is None else scan.no_return.nbytes)
    )
