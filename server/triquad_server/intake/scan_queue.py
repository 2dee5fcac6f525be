"""Scans on their way from the network to the mapper."""

import logging
import threading
from collections import deque
from collections.abc import Callable

import zenoh
from triquad_format.errors import FormatError, ProtocolVersionError, WireError
from triquad_format.wire import codec, keys
from triquad_format.wire.messages import Scan

from triquad_server.counter import Counter
from triquad_server.intake.sources import SourceLedger
from triquad_server.net.requests import payload_limit

_log = logging.getLogger(__name__)


class ScanQueue:
    """The newest scans that wait; where it is full, the oldest is pushed out and counted."""

    def __init__(self, limit: int) -> None:
        """At most ``limit`` scans wait."""
        self.limit = limit
        self.ledger = SourceLedger()
        self.dropped = Counter()  # scans that are not in the map, by reason
        self._lock = threading.Lock()
        self._scans: deque[Scan] = deque()
        self._in_hand = False

    def __len__(self) -> int:
        return len(self._scans) + self._in_hand

    def put(self, scan: Scan) -> None:
        """Add a scan, unless its sequence or stamp refuses it."""
        with self._lock:
            reason = self.ledger.arrive(scan)
            if reason is not None:
                self.dropped.add(reason)
                return
            self._scans.append(scan)
            pushed_out = self._scans.popleft() if len(self._scans) > self.limit else None
            if pushed_out is not None:
                self.ledger.push_out(pushed_out)

    def refuse(self, scan: Scan, reason: str, text: str) -> None:
        """Account for a scan that arrived but is not let in."""
        with self._lock:
            backwards = self.ledger.arrive(scan)
            if backwards is None:
                self.ledger.turn_away(scan, text)
            self.dropped.add(backwards or reason)

    def take(self) -> Scan | None:
        """The oldest waiting scan; it counts as waiting until the next one is asked for."""
        with self._lock:
            self._in_hand = bool(self._scans)
            return self._scans.popleft() if self._scans else None


class ScanIntake:
    """Receives scans from Zenoh, decodes them and puts them into the queue."""

    def __init__(
        self,
        session: zenoh.Session,
        map_name: str,
        queue: ScanQueue,
        *,
        max_points: int,
        arrived: Callable[[], None],
    ) -> None:
        """Begin to receive; ``arrived`` is called after each scan that was queued.

        Scans of more than ``max_points`` points are refused here, so that the queue, whose limit
        is a number of scans, is bounded in bytes too.
        """
        self._max_points = max_points
        self._queue = queue
        self._arrived = arrived
        # A ring, since a full channel of another kind would stall the network's threads.
        self._subscriber = session.declare_subscriber(
            keys.all_scans_key(map_name), zenoh.handlers.RingChannel(queue.limit)
        )
        self._thread = threading.Thread(target=self._run, name="scan-intake")
        self._thread.start()

    def close(self) -> None:
        """Take no more scans."""
        self._subscriber.undeclare()
        self._thread.join()

    def _run(self) -> None:
        for sample in self._subscriber:
            try:
                self._receive(str(sample.key_expr), sample.payload)
            except Exception:  # an internal error must not stop the intake of other scans
                self._queue.dropped.add("internal")
                _log.exception("a scan on %s could not be received", sample.key_expr)
            self._arrived()

    def _receive(self, key: str, payload: zenoh.ZBytes) -> None:
        max_bytes = payload_limit(self._max_points)
        if len(payload) > max_bytes:
            self._drop("too_large", key, f"{len(payload)} bytes exceed {max_bytes}")
            return
        try:
            scan = codec.decode(Scan, payload.to_bytes())
        except ProtocolVersionError as error:
            self._drop("bad_version", key, error)
        except WireError as error:
            self._drop("decode", key, error)
        else:
            self._enter(key, scan)

    def _enter(self, key: str, scan: Scan) -> None:
        """Put a decoded scan into the queue, where it may be there."""
        if key.rpartition("/")[2] != scan.source:
            self._drop("key_source_mismatch", key, f"its source is {scan.source!r:.80}")
            return
        try:
            keys.check_name("source", scan.source)
        except FormatError as error:
            self._drop("bad_source", key, error)
            return
        points = len(scan.points)
        if points > self._max_points:
            text = f"{points} points exceed the limit of {self._max_points}"
            self._queue.refuse(scan, "too_many_points", text)
            return
        self._queue.put(scan)

    def _drop(self, reason: str, key: str, cause: object) -> None:
        self._queue.dropped.add(reason)
        _log.debug("scan on %s dropped (%s): %s", key, reason, cause)
