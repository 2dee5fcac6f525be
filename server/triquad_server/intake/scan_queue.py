"""The intake of scans from the network, and their queue, in which they wait for the mapper."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection
from typing import NamedTuple

import zenoh
from triquad_format.errors import FormatError, ProtocolVersionError, WireError
from triquad_format.wire import codec, keys
from triquad_format.wire.limits import payload_limit
from triquad_format.wire.messages import Scan

from triquad_server.errors import ScanRefusedError
from triquad_server.fair_queue import FairQueue, Owner
from triquad_server.intake.rays import ScanRays
from triquad_server.intake.source_ledger import SourceLedger

_log = logging.getLogger(__name__)

MAX_SOURCES_WAITING = 64
"""The number of sources that may each have the full number of scans wait; more share that."""

_BEHIND = 0.5
"""A source falls behind if more than this share of its limit waits: then more of its scans are
taken, and questions give way to them."""

_GIVE_WAY_S = 0.05
"""Each question waits this many seconds at most: it is late then, but scans that do not fit in the
queue are lost."""

_MAX_BYTES = 100_000_000
"""The bytes of the scans of all sources that wait; of the source that has most, the oldest goes."""

_SURPLUS = 5
"""So many times the points that are used may come: an image of 1920 x 1080 pixels, for one."""

_SCAN_BYTES = 2_000  # memory of a scan in addition to its points


class _WaitingScan(NamedTuple):
    scan: Scan
    arrived_s: float  # monotonic


class ScanQueue:
    """Keeps the newest scans of each source that wait; sources take turns.

    Where there are too many, the oldest is pushed out and counted: of a source that has too many,
    or of the one that has most.
    """

    def __init__(
        self, limit: int, limit_bytes: int = _MAX_BYTES, *, is_shared: bool = False
    ) -> None:
        """Let at most ``limit`` scans of each source wait, and ``limit_bytes`` of all together.

        Several servers take them in where the map ``is_shared``.
        """
        self.limit = limit
        self.ledger = SourceLedger(is_shared=is_shared)
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

    @property
    def nbytes(self) -> int:
        """The bytes of the scans that wait."""
        return self._scans.nbytes

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
            self._falls_behind(waiting.scan.source) and waiting.arrived_s <= before_s
            for waiting in self._scans.oldest()
        )

    def _falls_behind(self, source: str) -> bool:
        return self._scans.count(source) > _BEHIND * self.limit


def _bytes_of(scan: Scan) -> int:
    return (
        _SCAN_BYTES + scan.points.nbytes + (0 if scan.no_return is None else scan.no_return.nbytes)
    )


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

        Messages that are larger than five times ``max_points`` points can be are dropped.
        """
        self._max_bytes = payload_limit(_SURPLUS * max_points)
        self._queue = queue
        self._arrived = arrived
        # Decoded in the network's own threads: who sends too much is slowed down, and no other.
        receive = zenoh.handlers.Callback(self._receive, indirect=False)
        self._subscriber = session.declare_subscriber(keys.all_scans_key(map_name), receive)

    def close(self) -> None:
        """Take no more scans."""
        self._subscriber.undeclare()

    def _receive(self, sample: zenoh.Sample) -> None:
        """Queue a scan; an internal error must not stop the intake of others."""
        key, payload = str(sample.key_expr), sample.payload
        self._queue.receive(len(payload))
        try:
            self._queue.put(self._decoded(key, payload))
        except ScanRefusedError as error:
            self._drop(error.reason, key, error)
        except MemoryError as error:
            self._drop("no_memory", key, error)
        except Exception:
            self._queue.drop("internal")
            _log.exception("a scan on %s could not be received", key)
        self._arrived()

    def _decoded(self, key: str, payload: zenoh.ZBytes) -> Scan:
        """Return the scan of a message that was published on a key.

        Raises:
            ScanRefusedError: it is none, or not that of the source that the key names.
        """
        if len(payload) > self._max_bytes:
            text = f"{len(payload)} bytes exceed {self._max_bytes}"
            raise ScanRefusedError("too_large", text)
        try:
            scan = codec.decode(Scan, payload.to_bytes())
        except ProtocolVersionError as error:
            raise ScanRefusedError("bad_version", str(error)) from error
        except WireError as error:
            raise ScanRefusedError("decode", str(error)) from error
        if key.rpartition("/")[2] != scan.source:
            raise ScanRefusedError("key_source_mismatch", f"its source is {scan.source!r:.80}")
        try:
            keys.check_name("source", scan.source)
        except FormatError as error:
            raise ScanRefusedError("bad_source", str(error)) from error
        return scan

    def _drop(self, reason: str, key: str, cause: object) -> None:
        self._queue.drop(reason)
        _log.debug("scan on %s dropped (%s): %s", key, reason, cause)
