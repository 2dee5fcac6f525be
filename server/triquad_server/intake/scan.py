"""Receives scans from the network, decodes them, and queues them if they are accepted."""

import logging
import threading
from collections.abc import Callable

import zenoh
from triquad_format.errors import FormatError, ProtocolVersionError, WireError
from triquad_format.wire import codec, keys
from triquad_format.wire.limits import payload_limit
from triquad_format.wire.messages import Scan

from triquad_server.errors import ScanRefusedError
from triquad_server.fair_queue import FairQueue, Owner
from triquad_server.intake.rays import check_count
from triquad_server.intake.scan_queue import ScanQueue

_log = logging.getLogger(__name__)

_INBOX = 1024
"""The number of scan messages that wait to be decoded."""


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

        Scans of more than ``max_points`` points are refused here, before they wait.
        """
        self._max_points = max_points
        self._queue = queue
        self._arrived = arrived
        # Scans as received, by key: decoding takes time, too, which one source may use up.
        self._inbox: FairQueue[zenoh.Sample] = FairQueue(
            _INBOX, queue.limit_bytes, _INBOX, newest_go=False
        )
        self._changed = threading.Condition()  # the inbox, or whether to stop
        self._stopping = False
        # This runs in the network's own threads, so it only queues scans.
        keep = zenoh.handlers.Callback(self._keep, indirect=False)
        self._subscriber = session.declare_subscriber(keys.all_scans_key(map_name), keep)
        self._thread = threading.Thread(target=self._run, name="scan-intake")
        self._thread.start()

    def close(self) -> None:
        """Take no more scans."""
        self._subscriber.undeclare()
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        while (sample := self._next()) is not None:
            self._receive_safely(sample)

    def _next(self) -> zenoh.Sample | None:
        """Return the next scan; ``None`` where no more will come."""
        with self._changed:
            self._changed.wait_for(lambda: len(self._inbox) or self._stopping)
            return self._inbox.take()

    def _keep(self, sample: zenoh.Sample) -> None:
        with self._changed:
            self._queue.received_bytes += len(sample.payload)
            # What is removed for it is a gap in the sequence, and counted as that.
            self._inbox.put(Owner(str(sample.key_expr)), sample, len(sample.payload))
            self._changed.notify_all()

    def _receive_safely(self, sample: zenoh.Sample) -> None:
        """Do as :meth:`_receive`; an internal error must not stop the intake of other scans."""
        try:
            self._receive(str(sample.key_expr), sample.payload)
        except Exception:
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
        """Put a decoded scan into the queue, if it is accepted."""
        if key.rpartition("/")[2] != scan.source:
            self._drop("key_source_mismatch", key, f"its source is {scan.source!r:.80}")
            return
        try:
            keys.check_name("source", scan.source)
        except FormatError as error:
            self._drop("bad_source", key, error)
            return
        try:
            check_count(scan.points, scan.no_return, self._max_points)
        except ScanRefusedError as error:
            self._queue.refuse(scan, error.reason, str(error))
            return
        self._queue.put(scan)

    def _drop(self, reason: str, key: str, cause: object) -> None:
        self._queue.dropped.add(reason)
        _log.debug("scan on %s dropped (%s): %s", key, reason, cause)
