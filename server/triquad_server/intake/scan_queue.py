"""The queue of scans, and the ledger of what became of each: taken, refused or lost."""

import threading
import time
from collections import OrderedDict
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import NamedTuple

from triquad_format.wire.messages import FlushReply, Scan
from triquad_format.wire.metrics_messages import SourceMetrics

from triquad_server.counter import Counter
from triquad_server.fair_queue import FairQueue, Owner

MAX_SESSIONS = 1024
"""Sessions of publishers that are remembered; the one heard of longest ago is forgotten."""

MAX_SOURCES_LISTED = 64

MAX_SOURCES_WAITING = 64
"""Sources that may each have as many scans wait as one may; more share that."""

_SCAN_BYTES = 2_000  # that a scan takes beside its points

MAX_SEQUENCE = 2**48

_AHEAD_AT_ONCE = 1000
_AHEAD_PER_S = 1000
"""How far sequences may leap: as many scans as may get lost at once, and in each second in which
nothing was heard of the session. Whoever leaps farther does not count on from where it was."""

FORGOTTEN = "*"
"""Stands for all forgotten sources where losses are listed."""

_MAX_COUNT = 2**63 - 1


class Refusals(NamedTuple):
    """Refused scans of one source."""

    scans: int
    last: str  # why the last of them was


@dataclass
class _Track:
    """Counts of one session of one source. Scans of one session stay in order all the way."""

    arrived: int = -1  # highest sequence that arrived or was given up
    done: int = -1  # highest sequence that came out of the queue
    waiting: int = 0  # scans in the queue
    unpublished: int | None = None  # lowest sequence taken that no epoch shows yet
    unpublished_scans: int = 0  # taken, that no epoch shows yet
    stamp_ns: int = -(2**63)
    taken: int = 0
    refused: int = 0
    lost: int = 0
    last_refusal: str | None = None
    heard_s: float = field(default_factory=time.monotonic)  # of it last, monotonic

    def lose_up_to(self, sequence: int) -> None:
        """Count what did not arrive, up to and with ``sequence``, as lost."""
        self.lost += max(0, sequence - self.arrived)
        self.arrived = max(self.arrived, sequence)

    def is_ahead(self, sequence: int) -> bool:
        """Whether a sequence lies farther ahead than scans can have got lost since the last."""
        if self.arrived < 0:
            return False  # it may have begun long before this process
        silent_s = time.monotonic() - self.heard_s
        return sequence - self.arrived > _AHEAD_AT_ONCE + _AHEAD_PER_S * silent_s

    def refuse(self, text: str) -> None:
        """Count a refused scan."""
        self.refused += 1
        self.last_refusal = text

    def settled(self, sequence: int) -> bool:
        """Whether a scan was taken, refused or lost."""
        return sequence <= (self.done if self.waiting else self.arrived)


class SourceLedger:
    """Accounts for every scan by source, session and sequence; safe for any thread.

    Counts are those of this process: a scan of a session that it never received is lost.
    """

    def __init__(self) -> None:
        self.changed = threading.Condition()  # notified when the outcome of a scan may be known
        self._tracks: OrderedDict[tuple[str, int], _Track] = OrderedDict()
        self._forgotten_lost = 0

    def arrive(self, scan: Scan) -> str | None:
        """Record a scan's arrival; the reason where its sequence or stamp refuses it."""
        with self.changed:
            if not 0 <= scan.sequence < MAX_SEQUENCE:
                return "bad_sequence"
            track = self._track(scan.source, scan.session)
            if track.is_ahead(scan.sequence):
                return "sequence_ahead"
            track.heard_s = time.monotonic()
            if scan.sequence <= track.arrived:
                return "sequence_backwards"
            track.lose_up_to(scan.sequence - 1)
            track.arrived = scan.sequence
            if scan.stamp_ns < track.stamp_ns:
                track.refuse(
                    f"scan {scan.sequence}: its stamp {scan.stamp_ns} ns lies before the "
                    f"{track.stamp_ns} ns of the scan before; stamp scans in order"
                )
                track.stamp_ns = scan.stamp_ns  # a clock that was set back costs one scan
                self.changed.notify_all()
                return "time_backwards"
            track.stamp_ns = scan.stamp_ns
            track.waiting += 1
            return None

    def take(self, scan: Scan) -> None:
        """Record that a scan went into the map."""
        with self.changed:
            track = self._leave_queue(scan)
            track.taken += 1
            track.unpublished_scans += 1
            if track.unpublished is None:
                track.unpublished = scan.sequence

    def refuse(self, scan: Scan, text: str) -> None:
        """Record that the map refused a scan."""
        with self.changed:
            self._leave_queue(scan).refuse(f"scan {scan.sequence}: {text}")

    def turn_away(self, scan: Scan, text: str) -> None:
        """Record that a scan that just arrived is not let into the queue.

        Earlier ones may still wait there, so it says nothing of them.
        """
        with self.changed:
            track = self._track(scan.source, scan.session)
            track.waiting = max(0, track.waiting - 1)
            track.refuse(f"scan {scan.sequence}: {text}")
            self.changed.notify_all()

    def push_out(self, scan: Scan) -> None:
        """Record that a scan was pushed out of the full queue."""
        with self.changed:
            self._leave_queue(scan).lost += 1

    def take_back(self, why: str) -> int:
        """Record that scans which no epoch shows yet are not in the map after all; how many."""
        with self.changed:
            count = 0
            for track in self._tracks.values():
                if track.unpublished is None:
                    continue
                count += track.unpublished_scans
                track.taken -= track.unpublished_scans
                track.refused += track.unpublished_scans
                track.last_refusal = f"scan {track.unpublished} and later ones: {why}"
                track.unpublished, track.unpublished_scans = None, 0
            self.changed.notify_all()
            return count

    def publish(self) -> None:
        """Record that an epoch shows all scans that were taken so far."""
        with self.changed:
            shown = [track for track in self._tracks.values() if track.unpublished is not None]
            for track in shown:
                track.unpublished, track.unpublished_scans = None, 0
            if shown:
                self.changed.notify_all()

    def give_up(self, source: str, session: int, sequence: int) -> FlushReply | None:
        """Count what has not arrived up to ``sequence`` as lost; the outcome, as :meth:`outcome`.

        What cannot have been sent is answered but not remembered, be it of a session that was never
        heard of or far ahead in one: questions must not push out, nor hold up, who sends scans.
        """
        with self.changed:
            track = self._tracks.get((source, session))
            if track is None:
                return FlushReply(taken=0, refused=0, lost=sequence + 1, last_refusal=None)
            if track.is_ahead(sequence):
                lost = track.lost + sequence - track.arrived
                return FlushReply(track.taken, track.refused, lost, track.last_refusal)
            track.lose_up_to(sequence)
            return self.outcome(source, session, sequence)

    def arrived(self, source: str, session: int, sequence: int) -> bool:
        """Whether a scan, or a later one of its session, arrived."""
        with self.changed:
            track = self._tracks.get((source, session))
            return track is not None and sequence <= track.arrived

    def settled(self, source: str, session: int, sequence: int) -> bool:
        """Whether a scan was taken, refused or lost."""
        with self.changed:
            track = self._tracks.get((source, session))
            return track is not None and track.settled(sequence)

    def outcome(self, source: str, session: int, sequence: int) -> FlushReply | None:
        """The counts of a session, once the scan is settled and an epoch shows it if taken."""
        with self.changed:
            track = self._tracks.get((source, session))
            if track is None or not track.settled(sequence):
                return None
            if track.unpublished is not None and track.unpublished <= sequence:
                return None
            return FlushReply(track.taken, track.refused, track.lost, track.last_refusal)

    def lost(self) -> dict[str, int]:
        """Scans lost, by source."""
        with self.changed:
            counts = {FORGOTTEN: self._forgotten_lost} if self._forgotten_lost else {}
            for (source, _), track in self._tracks.items():
                if track.lost:
                    counts[source] = min(_MAX_COUNT, counts.get(source, 0) + track.lost)
            return counts

    def sources(self) -> dict[str, SourceMetrics]:
        """The scans of each source; those heard of longest ago are put together where many are."""
        now = time.monotonic()
        found: dict[str, SourceMetrics] = {}
        with self.changed:
            for (source, _), track in reversed(self._tracks.items()):
                name = source if source in found or len(found) < MAX_SOURCES_LISTED else FORGOTTEN
                found[name] = _with_track(found.get(name), track, now - track.heard_s)
        return found

    def refused(self) -> dict[str, Refusals]:
        """Scans refused, by source."""
        with self.changed:
            found: dict[str, Refusals] = {}
            for (source, _), track in self._tracks.items():
                if track.last_refusal is not None:
                    before = found[source].scans if source in found else 0
                    found[source] = Refusals(before + track.refused, track.last_refusal)
            return found

    def _leave_queue(self, scan: Scan) -> _Track:
        track = self._track(scan.source, scan.session)
        track.waiting = max(0, track.waiting - 1)
        track.done = max(track.done, scan.sequence)
        self.changed.notify_all()
        return track

    def _track(self, source: str, session: int) -> _Track:
        """The track of a session, now the one heard of last."""
        track = self._tracks.setdefault((source, session), _Track())
        self._tracks.move_to_end((source, session))
        if len(self._tracks) > MAX_SESSIONS:
            _, forgotten = self._tracks.popitem(last=False)
            self._forgotten_lost = min(_MAX_COUNT, self._forgotten_lost + forgotten.lost)
        return track


def _with_track(before: SourceMetrics | None, track: _Track, age_s: float) -> SourceMetrics:
    """The scans of a source, with those of one more of its sessions."""
    if before is None:
        return SourceMetrics(1, track.taken, track.refused, track.lost, age_s)
    return SourceMetrics(
        sessions=before.sessions + 1,
        taken=before.taken + track.taken,
        refused=before.refused + track.refused,
        lost=min(_MAX_COUNT, before.lost + track.lost),
        age_s=min(before.age_s, age_s),
    )


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
        self.received = self.received_bytes = 0  # messages of scans, whatever became of them
        self._lock = threading.Lock()
        self._scans: FairQueue[Scan] = FairQueue(limit * MAX_SOURCES_WAITING, limit_bytes)
        self._in_hand = False

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
            if self._scans.count(owner) > self.limit:
                self.ledger.push_out(self._scans.drop_oldest(owner))
            for pushed_out in self._scans.excess(newest=False):
                self.ledger.push_out(pushed_out)

    def refuse(self, scan: Scan, reason: str, text: str) -> None:
        """Account for a scan that arrived but is not let in."""
        with self._lock:
            backwards = self.ledger.arrive(scan)
            if backwards is None:
                self.ledger.turn_away(scan, text)
            self.dropped.add(backwards or reason)

    def take(self, but: Collection[str] = ()) -> Scan | None:
        """The oldest scan of the next source, not one of ``but``.

        It counts as waiting until another is asked for.
        """
        with self._lock:
            scan = self._scans.take(lambda scan: scan.source not in but)
            self._in_hand = scan is not None
            return scan


def _bytes_of(scan: Scan) -> int:
    return (
        _SCAN_BYTES + scan.points.nbytes + (0 if scan.no_return is None else scan.no_return.nbytes)
    )
