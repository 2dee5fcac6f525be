"""Receives scans from the network, decodes them, and queues them if they are accepted."""

import logging
from collections.abc import Callable

import zenoh
from triquad_format.errors import FormatError, ProtocolVersionError, WireError
from triquad_format.wire import codec, keys
from triquad_format.wire.limits import payload_limit
from triquad_format.wire.messages import Scan

from triquad_server.errors import ScanRefusedError
from triquad_server.intake.rays import check_count
from triquad_server.intake.scan_queue import ScanQueue

_log = logging.getLogger(__name__)


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
        # Decoded in the network's own threads: who sends too much is slowed down, and no other.
        receive = zenoh.handlers.Callback(self._receive_safely, indirect=False)
        self._subscriber = session.declare_subscriber(keys.all_scans_key(map_name), receive)

    def close(self) -> None:
        """Take no more scans."""
        self._subscriber.undeclare()

    def _receive_safely(self, sample: zenoh.Sample) -> None:
        """Do as :meth:`_receive`; an internal error must not stop the intake of other scans."""
        self._queue.receive(len(sample.payload))
        try:
            self._receive(str(sample.key_expr), sample.payload)
        except MemoryError as error:
            self._drop("no_memory", str(sample.key_expr), error)
        except Exception:
            self._queue.drop("internal")
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
        self._queue.drop(reason)
        _log.debug("scan on %s dropped (%s): %s", key, reason, cause)
