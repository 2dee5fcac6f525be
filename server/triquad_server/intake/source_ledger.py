"""Records what became of each scan, by source: taken, refused or lost; and answers who asks."""

import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from triquad_format.wire.limits import MAX_SEQUENCE
from triquad_format.wire.messages import FlushReply, FlushRequest, Scan
from triquad_format.wire.metrics_messages import SourceMetrics

MAX_SESSIONS = 1024
"""The number of publishers' sessions that are kept; the one heard of longest ago is removed, with
its counts."""

MAX_LEAP = 1_000_000
"""The most by which a sequence may lie above the last of its session: half a day of lost scans. One
that lies farther ahead is forged or corrupt, and must not make those that follow seem old."""

ARRIVAL_GRACE_S = 2.0
"""A scan that has not arrived this many seconds after the first flush request, which travels the
same way behind it, is lost."""

_MAX_COUNT = 2**63 - 1

_NOTHING_YET = FlushReply(done=False, taken=0, refused=0, lost=0, last_refusal=None)


@dataclass
class ScanCounts:
    """What became of the scans of a session, or of several."""

    sessions: int = 1
    taken: int = 0
    refused: int = 0
    pushed_out: int = 0  # of the full queue
    never_arrived: int = 0
    last_refusal: str | None = None  # why the last of them was refused
    heard_s: float = -float("inf")  # when a session was last heard of, monotonic

    @property
    def lost(self) -> int:
        """The number of lost scans, pushed out or never arrived."""
        return min(_MAX_COUNT, self.pushed_out + self.never_arrived)

    def plus(self, other: "ScanCounts") -> "ScanCounts":
        """Return these counts and those of ``other`` sessions together."""
        newest = max(self, other, key=lambda counts: counts.heard_s)
        return ScanCounts(
            self.sessions + other.sessions,
            self.taken + other.taken,
            self.refused + other.refused,
            self.pushed_out + other.pushed_out,
            self.never_arrived + other.never_arrived,
            newest.last_refusal or self.last_refusal or other.last_refusal,
            newest.heard_s,
        )


@dataclass
class _Session:
    """The scans of one session of one source, which stay in order all the way."""

    counts: ScanCounts = field(default_factory=ScanCounts)
    arrived: int = -1  # highest sequence so far
    waiting: deque[int] = field(default_factory=deque)  # sequences of the scans in the queue
    unpublished: int | None = None  # lowest sequence taken that no epoch shows yet
    stamp_ns: int = -(2**63)

    def is_settled(self, sequence: int) -> bool:
        """Return whether all scans up to a sequence arrived, and left the queue."""
        return sequence <= self.arrived and not (self.waiting and self.waiting[0] <= sequence)

    def is_shown(self, sequence: int) -> bool:
        """Return whether an epoch shows all scans that were taken up to a sequence."""
        return self.unpublished is None or self.unpublished > sequence

    def refuse(self, text: str) -> None:
        """Count a refused scan."""
        self.counts.refused += 1
        self.counts.last_refusal = text


class SourceLedger:
    """Accounts for every scan by source, session and sequence; safe for any thread.

    Counts are those of this process: a scan of a session that it never received is lost.
    """

    def __init__(self, *, is_shared: bool = False) -> None:
        """Begin; where servers share a map, one that is started later counts from then on."""
        self._lock = threading.Lock()
        self._is_shared = is_shared
        self._sessions: OrderedDict[tuple[str, int], _Session] = OrderedDict()

    def arrive(self, scan: Scan) -> str | None:
        """Record a scan's arrival; return the reason if its sequence or stamp refuses it."""
        with self._lock:
            if not 0 <= scan.sequence <= MAX_SEQUENCE:
                return "bad_sequence"
            session = self._session(scan)
            if 0 <= session.arrived < scan.sequence - MAX_LEAP:
                return "sequence_ahead"
            session.counts.heard_s = time.monotonic()
            if self._is_shared and session.arrived < 0:
                session.arrived = scan.sequence - 1
            if scan.sequence <= session.arrived:
                return "sequence_backwards"
            session.counts.never_arrived += scan.sequence - session.arrived - 1
            session.arrived = scan.sequence
            before_ns, session.stamp_ns = session.stamp_ns, scan.stamp_ns
            if scan.stamp_ns < before_ns:  # a clock that was set back costs one scan
                session.refuse(
                    f"scan {scan.sequence}: its stamp {scan.stamp_ns} ns lies before the "
                    f"{before_ns} ns of the scan before; stamp scans in order"
                )
                return "time_backwards"
            session.waiting.append(scan.sequence)
            return None

    def take(self, scan: Scan) -> None:
        """Record that a scan went into the map."""
        with self._lock:
            session = self._leave_queue(scan)
            session.counts.taken += 1
            if session.unpublished is None:
                session.unpublished = scan.sequence

    def refuse(self, scan: Scan, text: str) -> None:
        """Record that a scan was refused: by the map, or before it was queued."""
        with self._lock:
            self._leave_queue(scan).refuse(f"scan {scan.sequence}: {text}")

    def push_out(self, scan: Scan) -> None:
        """Record that a scan was pushed out of the full queue."""
        with self._lock:
            self._leave_queue(scan).counts.pushed_out += 1

    def publish(self) -> None:
        """Record that an epoch shows all scans that were taken so far."""
        with self._lock:
            for session in self._sessions.values():
                session.unpublished = None

    def is_settled(self, source: str, session: int, sequence: int) -> bool:
        """Return whether a scan was taken, refused or lost."""
        with self._lock:
            known = self._sessions.get((source, session))
            return known is not None and known.is_settled(sequence)

    def outcome(
        self, source: str, session: int, sequence: int, *, overdue: bool = False
    ) -> FlushReply:
        """Return a session's counts; done once a scan is settled and an epoch shows it if taken.

        Scans that are ``overdue`` and did not arrive are answered as lost. That is not recorded:
        they may still come, and requests must neither push out nor delay sources of scans.
        """
        with self._lock:
            known = self._sessions.get((source, session))
            if known is None:
                return _of_stranger(source, sequence) if overdue else _NOTHING_YET
            missing = max(0, sequence - known.arrived) if overdue else 0
            newest = min(sequence, known.arrived) if overdue else sequence
            return FlushReply(
                done=known.is_settled(newest) and known.is_shown(newest),
                taken=known.counts.taken,
                refused=known.counts.refused,
                lost=min(_MAX_COUNT, known.counts.lost + missing),
                last_refusal=known.counts.last_refusal,
            )

    def answer(
        self,
        request: FlushRequest,
        publish_soon: Callable[[], None],
        warnings: Callable[[str], tuple[str, ...]],
    ) -> FlushReply:
        """Return what became of the scans of a session, at once: who is not done asks again.

        ``publish_soon`` requests an epoch from the mapper; ``warnings`` returns those about a
        source.
        """
        scan = request.source, request.session, request.sequence
        reply = self.outcome(*scan, overdue=request.waited_s >= ARRIVAL_GRACE_S)
        if not reply.done:
            if self.is_settled(*scan):
                publish_soon()
            return reply
        return replace(reply, warnings=reply.warnings + warnings(request.source))

    def lost(self) -> dict[str, int]:
        """Return the number of lost scans, by source."""
        return {source: counts.lost for source, counts in self.by_source().items() if counts.lost}

    def by_source(self) -> dict[str, ScanCounts]:
        """Return what became of the scans of each source, the one heard of last first."""
        with self._lock:
            found: dict[str, ScanCounts] = {}
            for (source, _), session in reversed(self._sessions.items()):
                known = found.get(source, ScanCounts(sessions=0))
                found[source] = known.plus(session.counts)
            return found

    def metrics(self) -> dict[str, SourceMetrics]:
        """Return the scans of each source, as far as its sessions are remembered."""
        sources = self.by_source().items()
        now = time.monotonic()  # not before a scan that arrived meanwhile
        return {
            name: SourceMetrics(one.sessions, one.taken, one.refused, one.lost, now - one.heard_s)
            for name, one in sources
        }

    def _leave_queue(self, scan: Scan) -> _Session:
        session = self._session(scan)
        # One that was forgotten meanwhile knows of no scan.
        if scan.sequence in session.waiting:
            session.waiting.remove(scan.sequence)
        return session

    def _session(self, scan: Scan) -> _Session:
        """Return the session of a scan, now the most recent one."""
        key = (scan.source, scan.session)
        counts = ScanCounts(heard_s=time.monotonic())
        session = self._sessions.setdefault(key, _Session(counts))
        self._sessions.move_to_end(key)
        if len(self._sessions) > MAX_SESSIONS:
            self._sessions.popitem(last=False)
        return session


def _of_stranger(source: str, sequence: int) -> FlushReply:
    """Return the reply about a session of which nothing is known."""
    return FlushReply(
        done=True,
        taken=0,
        refused=0,
        lost=sequence + 1,
        last_refusal=None,
        warnings=(
            f"source {source!r}: none of this client's scans arrived: access control does not let "
            "it publish as this source (a role names its sources), or the server was started again "
            "since",
        ),
    )
