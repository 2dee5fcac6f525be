"""Records what became of each scan, by source: taken, refused or lost."""

import threading
import time
from collections import OrderedDict
from dataclasses import dataclass, field
from typing import NamedTuple

from triquad_format.wire.messages import FlushReply, Scan
from triquad_format.wire.metrics_messages import SourceMetrics

MAX_SESSIONS = 1024
"""The number of publishers' sessions that are kept; the one heard of longest ago is removed."""

MAX_SOURCES_LISTED = 64

MAX_SEQUENCE = 2**48

_AHEAD_AT_ONCE = 1000
_AHEAD_PER_S = 1000
"""The largest leap of sequences: as many scans as may get lost at once, and in each second in
which the session was silent. A source that leaps farther does not count on from its last one."""

FORGOTTEN = "*"
"""The name that stands for all forgotten sources where losses are listed."""

_MAX_COUNT = 2**63 - 1


class Refusals(NamedTuple):
    """The refused scans of one source."""

    scans: int
    last: str  # why the last of them was refused


class Losses(NamedTuple):
    """The lost scans of one source."""

    pushed_out: int  # pushed out of the full queue
    never_arrived: int


@dataclass
class _Track:
    """Counters of one session of one source; scans of one session stay in order all the way."""

    arrived: int = -1  # highest sequence that arrived or was given up
    done: int = -1  # highest sequence that came out of the queue
    waiting: int = 0  # scans in the queue
    unpublished: int | None = None  # lowest sequence taken that no epoch shows yet
    stamp_ns: int = -(2**63)
    taken: int = 0
    refused: int = 0
    pushed_out: int = 0  # pushed out of the full queue
    never_arrived: int = 0
    last_refusal: str | None = None
    heard_s: float = field(default_factory=time.monotonic)  # when it was last heard of, monotonic

    @property
    def lost(self) -> int:
        """The number of lost scans, of either kind."""
        return self.pushed_out + self.never_arrived

    def lose_up_to(self, sequence: int) -> None:
        """Count scans up to and with ``sequence`` that did not arrive as lost."""
        self.never_arrived += max(0, sequence - self.arrived)
        self.arrived = max(self.arrived, sequence)

    def is_ahead(self, sequence: int) -> bool:
        """Return whether a sequence lies farther ahead than scans can have got lost since."""
        if self.arrived < 0:
            return False  # it may have begun long before this process
        silent_s = time.monotonic() - self.heard_s
        return sequence - self.arrived > _AHEAD_AT_ONCE + _AHEAD_PER_S * silent_s

    def refuse(self, text: str) -> None:
        """Count a refused scan."""
        self.refused += 1
        self.last_refusal = text

    def settled(self, sequence: int) -> bool:
        """Return whether a scan was taken, refused or lost."""
        return sequence <= (self.done if self.waiting else self.arrived)


class SourceLedger:
    """Accounts for every scan by source, session and sequence; safe for any thread.

    Counts are those of this process: a scan of a session that it never received is lost.
    """

    def __init__(self) -> None:
        self.changed = threading.Condition()  # notified when the outcome of a scan may be known
        self._tracks: OrderedDict[tuple[str, int], _Track] = OrderedDict()
        self._forgotten = Losses(0, 0)

    def arrive(self, scan: Scan) -> str | None:
        """Record a scan's arrival; return the reason if its sequence or stamp refuses it."""
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
            if track.unpublished is None:
                track.unpublished = scan.sequence

    def refuse(self, scan: Scan, text: str) -> None:
        """Record that the map refused a scan."""
        with self.changed:
            self._leave_queue(scan).refuse(f"scan {scan.sequence}: {text}")

    def turn_away(self, scan: Scan, text: str) -> None:
        """Record that a scan that just arrived is not queued.

        Earlier ones may still wait there, so this settles none of them.
        """
        with self.changed:
            track = self._track(scan.source, scan.session)
            track.waiting = max(0, track.waiting - 1)
            track.refuse(f"scan {scan.sequence}: {text}")
            self.changed.notify_all()

    def push_out(self, scan: Scan) -> None:
        """Record that a scan was pushed out of the full queue."""
        with self.changed:
            self._leave_queue(scan).pushed_out += 1

    def publish(self) -> None:
        """Record that an epoch shows all scans that were taken so far."""
        with self.changed:
            shown = [track for track in self._tracks.values() if track.unpublished is not None]
            for track in shown:
                track.unpublished = None
            if shown:
                self.changed.notify_all()

    def give_up(self, source: str, session: int, sequence: int) -> FlushReply | None:
        """Count scans up to ``sequence`` that did not arrive as lost; return as :meth:`outcome`.

        Sequences that cannot have been sent are answered but not recorded, be it of a session that
        is unknown or far ahead in one: requests must not push out, nor delay, sources of scans.
        """
        with self.changed:
            track = self._tracks.get((source, session))
            if track is None:
                return FlushReply(
                    taken=0,
                    refused=0,
                    lost=sequence + 1,
                    last_refusal=None,
                    warnings=f"source {source!r}: none of this client's scans arrived: access "
                    "control does not let it publish as this source (a role names its sources), "
                    "or the server was started again since",
                )
            if track.is_ahead(sequence):
                lost = track.lost + sequence - track.arrived
                return FlushReply(track.taken, track.refused, lost, track.last_refusal)
            track.lose_up_to(sequence)
            return self.outcome(source, session, sequence)

    def arrived(self, source: str, session: int, sequence: int) -> bool:
        """Return whether a scan, or a later one of its session, arrived."""
        with self.changed:
            track = self._tracks.get((source, session))
            return track is not None and sequence <= track.arrived

    def settled(self, source: str, session: int, sequence: int) -> bool:
        """Return whether a scan was taken, refused or lost."""
        with self.changed:
            track = self._tracks.get((source, session))
            return track is not None and track.settled(sequence)

    def outcome(self, source: str, session: int, sequence: int) -> FlushReply | None:
        """Return a session's counts, once the scan is settled and an epoch shows it if taken."""
        with self.changed:
            track = self._tracks.get((source, session))
            if track is None or not track.settled(sequence):
                return None
            if track.unpublished is not None and track.unpublished <= sequence:
                return None
            return FlushReply(track.taken, track.refused, track.lost, track.last_refusal)

    def lost(self) -> dict[str, int]:
        """Return the number of lost scans, by source."""
        return {source: min(_MAX_COUNT, sum(lost)) for source, lost in self.losses().items()}

    def losses(self) -> dict[str, Losses]:
        """Return the lost scans, by source and by cause."""
        with self.changed:
            found = {FORGOTTEN: self._forgotten} if any(self._forgotten) else {}
            for (source, _), track in self._tracks.items():
                if track.lost:
                    found[source] = _with_losses(found.get(source, Losses(0, 0)), track)
            return found

    def sources(self) -> dict[str, SourceMetrics]:
        """Return the scans of each source; of many, those heard of longest ago are merged."""
        now = time.monotonic()
        found: dict[str, SourceMetrics] = {}
        with self.changed:
            for (source, _), track in reversed(self._tracks.items()):
                name = source if source in found or len(found) < MAX_SOURCES_LISTED else FORGOTTEN
                found[name] = _with_track(found.get(name), track, now - track.heard_s)
        return found

    def refused(self) -> dict[str, Refusals]:
        """Return the refused scans, by source."""
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
        """Return the track of a session, now the most recent one."""
        track = self._tracks.setdefault((source, session), _Track())
        self._tracks.move_to_end((source, session))
        if len(self._tracks) > MAX_SESSIONS:
            _, forgotten = self._tracks.popitem(last=False)
            self._forgotten = _with_losses(self._forgotten, forgotten)
        return track


def _with_losses(before: Losses, track: _Track) -> Losses:
    """Return the losses of a source, with those of one more session."""
    return Losses(
        pushed_out=min(_MAX_COUNT, before.pushed_out + track.pushed_out),
        never_arrived=min(_MAX_COUNT, before.never_arrived + track.never_arrived),
    )


def _with_track(before: SourceMetrics | None, track: _Track, age_s: float) -> SourceMetrics:
    """Return the scans of a source, with those of one more of its sessions."""
    if before is None:
        return SourceMetrics(1, track.taken, track.refused, track.lost, age_s)
    return SourceMetrics(
        sessions=before.sessions + 1,
        taken=before.taken + track.taken,
        refused=before.refused + track.refused,
        lost=min(_MAX_COUNT, before.lost + track.lost),
        age_s=min(before.age_s, age_s),
    )
