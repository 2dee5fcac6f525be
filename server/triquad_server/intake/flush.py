"""Flush requests: held, without holding up any worker, until their scans show in the map."""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from triquad_format.errors import FormatError, RefusedError
from triquad_format.wire import keys
from triquad_format.wire.messages import FlushRequest

from triquad_server.intake.sources import MAX_SEQUENCE, SourceLedger
from triquad_server.net.request import Request

_log = logging.getLogger(__name__)

ARRIVAL_GRACE_S = 2.0
"""A scan that has not arrived so long after the flush request, which travels the same way behind
it, is lost."""

_PAUSE_S = 0.25


@dataclass(frozen=True)
class _Held:
    """A flush request that waits."""

    request: Request
    asks: FlushRequest
    give_up_at: float  # monotonic, seconds
    deadline: float  # monotonic, seconds


class FlushDesk:
    """Answers flush requests on a thread of its own."""

    def __init__(
        self,
        ledger: SourceLedger,
        publish_soon: Callable[[], None],
        timeout_max_s: float,
        limit: int,
    ) -> None:
        """``limit`` requests are held at most; ``publish_soon`` asks the mapper for an epoch."""
        self._ledger = ledger
        self._publish_soon = publish_soon
        self._timeout_max_s = timeout_max_s
        self._limit = limit
        self._held: list[_Held] = []
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="flush")

    def start(self) -> None:
        """Begin to answer."""
        self._thread.start()

    def close(self) -> None:
        """Turn away what is held, and end."""
        with self._ledger.changed:
            self._stopping = True
            self._ledger.changed.notify_all()
        if self._thread.ident is not None:
            self._thread.join()

    def hold(self, request: Request, asks: FlushRequest) -> None:
        """Take over a request; it is answered once its scan is settled.

        Raises:
            RefusedError: a field is out of range, or too many are held.
        """
        self._check(asks)
        now = time.monotonic()
        with self._ledger.changed:
            if self._stopping or len(self._held) >= self._limit:
                raise RefusedError("busy", f"{len(self._held)} flush requests wait already")
            held = _Held(request, asks, now + ARRIVAL_GRACE_S, now + asks.timeout_s)
            self._held.append(held)
            self._ledger.changed.notify_all()

    def _check(self, asks: FlushRequest) -> None:
        try:
            keys.check_name("source", asks.source)
        except FormatError as error:
            raise RefusedError("bad_request", str(error)) from error
        if not 0 <= asks.sequence < MAX_SEQUENCE:
            raise RefusedError(
                "bad_request",
                f"sequence = {asks.sequence} is out of range: use 0 to {MAX_SEQUENCE - 1}",
            )
        # Written so that NaN is refused as well.
        if not 0 <= asks.timeout_s <= self._timeout_max_s:
            raise RefusedError(
                "bad_request",
                f"timeout_s = {asks.timeout_s} is out of range: use 0 to {self._timeout_max_s:g}",
            )

    def _run(self) -> None:
        while True:
            with self._ledger.changed:
                if not (self._stopping or any(self._ready(entry) for entry in self._held)):
                    self._ledger.changed.wait(_PAUSE_S if self._held else None)
                if self._stopping:
                    break
                held = list(self._held)
            for entry in held:
                if self._ended(entry):
                    with self._ledger.changed:
                        self._held.remove(entry)
        for entry in self._held:
            entry.request.refuse("timeout", "the server is stopping")

    def _ready(self, entry: _Held) -> bool:
        asks = entry.asks
        return self._ledger.outcome(asks.source, asks.session, asks.sequence) is not None

    def _ended(self, entry: _Held) -> bool:
        """As :meth:`_answer`; a defect ends this request only, not the thread of all others."""
        try:
            return self._answer(entry)
        except Exception as error:
            _log.exception("a flush request met a defect")
            entry.request.refuse("internal", f"{type(error).__name__}: {error}")
            return True

    def _answer(self, entry: _Held) -> bool:
        """Answer a request if it is time; False where it goes on waiting."""
        asks = entry.asks
        scan = (asks.source, asks.session, asks.sequence)
        now = time.monotonic()
        if not self._ledger.arrived(*scan) and now >= entry.give_up_at:
            reply = self._ledger.give_up(*scan)
        else:
            reply = self._ledger.outcome(*scan)
        if reply is not None:
            entry.request.answer(reply)
            return True
        if now >= entry.deadline:
            entry.request.refuse(
                "timeout",
                f"scan {asks.sequence} of {asks.source} is not in the map after {asks.timeout_s} s",
            )
            return True
        if self._ledger.settled(*scan):
            self._publish_soon()
        return False
