"""Publishing scans, and waiting until they are in the map."""

import logging
import secrets
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from triquad_format.errors import FormatError, InvalidInputError, RefusedError
from triquad_format.printable import printable
from triquad_format.wire import keys
from triquad_format.wire.messages import FlushReply, FlushRequest, Scan, ServerStatus

from triquad_client import checks
from triquad_client.calls import admin
from triquad_client.checks import PoseLike
from triquad_client.errors import InvalidScanError, RequestTimeoutError
from triquad_client.net.call import Ask, Call, Pause, ask_each
from triquad_client.net.connection import Connection

_log = logging.getLogger("triquad_client")

_REPLY_MARGIN_S = 5.0
"""The delay that the server's answer that the time is over may have."""

_SETTLE_FLUSH_S = 5.0
_SETTLE_PAUSE_S = 0.2


@dataclass(frozen=True)
class FlushReport:
    """The outcome of the scans that this client published."""

    taken: int  # learnt from
    refused: int  # seen by the server, but of no use
    lost: int  # never arrived, or pushed out of the server's full queue
    last_refusal: str | None  # by source, why the last of the refused ones was
    warnings: tuple[str, ...] = ()  # what goes wrong with the scans, and which setting helps


@dataclass
class _Source:
    """The progress of a source."""

    session: int = field(default_factory=lambda: secrets.randbits(62))
    next_sequence: int = 0
    stamp_ns: int = 0


class ScanPublisher:
    """Numbers and sends the scans of one client."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._sending = threading.Lock()
        self._lock = threading.Lock()  # of the dictionary, never locked for long
        self._sources: dict[str, _Source] = {}
        self._warned: set[str] = set()  # what was logged

    def publish(
        self,
        points: ArrayLike,
        world_from_sensor: PoseLike,
        stamp_s: float | None,
        *,
        source: str,
        no_return: ArrayLike | None,
    ) -> None:
        """Send a scan; arguments as in ``Client.publish_scan``."""
        try:
            key = keys.scan_key(self._connection.map_name, source)
        except FormatError as error:
            raise InvalidScanError(str(error)) from error
        pose = checks.rigid_pose(world_from_sensor)
        directions = None if no_return is None else checks.open_directions(no_return)
        # Rays that all met nothing are a scan, too.
        least = 1 if directions is None or len(directions) == 0 else 0
        cloud = np.ascontiguousarray(checks.scan_points(points, least=least))
        stamp_ns = time.time_ns() if stamp_s is None else checks.stamp_ns(stamp_s)
        # Locked while sending: the server takes a scan that is overtaken by its successor for lost.
        with self._sending:
            with self._lock:
                state = self._sources.setdefault(source, _Source())
            if stamp_ns < state.stamp_ns and stamp_s is None:
                stamp_ns = state.stamp_ns  # the system's clock was set back
            if stamp_ns < state.stamp_ns:
                raise InvalidScanError(
                    f"stamp_s = {stamp_s!r} lies before {state.stamp_ns / 1e9!r}, that of an "
                    f"earlier scan of source {source!r}; publish in order"
                )
            scan = Scan(
                points=cloud,
                world_from_sensor=pose,
                stamp_ns=stamp_ns,
                source=source,
                session=state.session,
                sequence=state.next_sequence,
                no_return=directions,
            )
            self._connection.put(key, scan)
            state.next_sequence += 1
            state.stamp_ns = stamp_ns

    def restart(self, source: str) -> None:
        """Let the next scan of a source have any stamp; as ``Client.restart_source``."""
        with self._sending, self._lock:
            self._sources.pop(source, None)

    def flush(self, timeout_s: float, pending: int) -> Call[FlushReport]:
        """Wait for the server; arguments as in ``Client.flush``."""
        wait_s = checks.within("timeout_s", timeout_s, checks.LONGEST_S, least=0.0)
        if pending < 0:
            raise InvalidInputError(f"pending = {pending!r}: use 0 or more")
        requests = list(self._requests(wait_s, pending))
        # All at once: each waits for its source, and they share the time.
        replies = yield from ask_each(requests, _ask_flush, at_once=len(requests))
        refusals = [
            f"source {request.source!r}: {reply.last_refusal}"
            for request, reply in zip(requests, replies, strict=True)
            if reply.last_refusal is not None
        ]
        warnings = tuple(line for reply in replies for line in (reply.warnings or "").splitlines())
        self._log_new(warnings)
        return FlushReport(
            taken=sum(reply.taken for reply in replies),
            refused=sum(reply.refused for reply in replies),
            lost=sum(reply.lost for reply in replies),
            last_refusal="; ".join(refusals) or None,
            warnings=warnings,
        )

    def settle(self, timeout_s: float) -> Call[ServerStatus]:
        """Wait for the scans and what is learnt from them; as ``Client.settle``."""
        deadline = checks.deadline(timeout_s)
        # A status that overtakes the last scan would say that there is nothing left to learn.
        while not (yield from self._dealt_with_by(deadline)):
            _check_time(deadline, timeout_s)
        while not (now := (yield from admin.status())).settled:
            _check_time(deadline, timeout_s)
            yield Pause(_SETTLE_PAUSE_S)
        return now

    def _log_new(self, warnings: tuple[str, ...]) -> None:
        """Log each warning once; the server says it in other words where it says it again."""
        with self._lock:
            new = [text for text in warnings if text not in self._warned]
            self._warned.update(new)
        for text in new:
            _log.warning("%s", printable(text))

    def _dealt_with_by(self, deadline: float) -> Call[bool]:
        """Return whether the scans are, after some waiting: servers bound the time of a request."""
        wait_s = min(max(deadline - time.monotonic(), 0.0), _SETTLE_FLUSH_S)
        try:
            yield from self.flush(wait_s, pending=0)
        except RefusedError as error:
            if error.code != "timeout":
                raise
            return False
        return True

    def _requests(self, timeout_s: float, pending: int) -> Iterator[FlushRequest]:
        """Yield one request per source; the scans that may be pending are shared out among them."""
        with self._lock:
            states = dict(self._sources)
        for source, state in states.items():
            target = state.next_sequence - 1 - pending // len(states)
            if target >= 0:
                yield FlushRequest(
                    source=source,
                    session=state.session,
                    sequence=target,
                    timeout_s=timeout_s,
                )


def _ask_flush(request: FlushRequest) -> Ask[FlushReply]:
    wait_s = request.timeout_s + _REPLY_MARGIN_S
    return Ask(keys.FLUSH, request, FlushReply, min_timeout_s=wait_s)


def _check_time(deadline: float, timeout_s: float) -> None:
    if time.monotonic() > deadline:
        raise RequestTimeoutError(f"the server still learns after {timeout_s:g} s")
