"""Flush requests: pending, without occupying any worker, until their scans show in the map."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

from triquad_format.errors import FormatError, RefusedError
from triquad_format.wire import keys
from triquad_format.wire.limits import MAX_FLUSH_S
from triquad_format.wire.messages import FlushReply, FlushRequest
from triquad_format.wire.metrics_messages import QueueMetrics

from triquad_server.fair_queue import first_to_go
from triquad_server.intake.source_ledger import MAX_SEQUENCE, SourceLedger
from triquad_server.process.threads import submit
from triquad_server.serving.operations import Lane, Operations
from triquad_server.serving.request import Request

ARRIVAL_GRACE_S = 2.0
"""A scan that has not arrived this many seconds after the flush request, which travels the same way
behind it, is lost."""

_SENDERS = 16
"""The number of replies sent at a time: clients that do not read them delay no others."""

_STOPPING = "the server is stopping"

Outcome = FlushReply | RefusedError
"""The answer to a request: a reply, or an error."""


@dataclass(frozen=True)
class _Pending:
    """A pending flush request."""

    request: Request
    asks: FlushRequest
    overdue_at: float  # monotonic, seconds: a scan that has not arrived by then is lost
    deadline: float  # monotonic, seconds

    @property
    def scan(self) -> tuple[str, int, int]:
        """The source, session and sequence of the scan."""
        return self.asks.source, self.asks.session, self.asks.sequence

    def send(self, outcome: Outcome, warnings: Callable[[str], str | None]) -> None:
        """Answer the request; an internal error ends this request only, not the thread."""
        try:
            if isinstance(outcome, RefusedError):
                self.request.refuse(outcome.code, str(outcome))
            else:
                lines = filter(None, (outcome.warnings, warnings(self.asks.source)))
                self.request.answer(replace(outcome, warnings="\n".join(lines) or None))
        except Exception as error:
            self.request.fail(error)


class FlushHandler:
    """Answers flush requests on a thread of its own.

    All decisions are made under the ledger's lock, whose notifications end the waiting.
    """

    def __init__(
        self,
        ledger: SourceLedger,
        publish_soon: Callable[[], None],
        limit: int,
        warnings: Callable[[str], str | None] = lambda _: None,
    ) -> None:
        """Begin to answer; ``publish_soon`` requests an epoch from the mapper.

        At most ``limit`` requests are pending; of more, the newest of the client that has most of
        them is refused. ``warnings`` returns those about a source.
        """
        self._ledger = ledger
        self._publish_soon = publish_soon
        self._limit = limit
        self._warnings = warnings
        self._pending: list[_Pending] = []
        self._excess: list[_Pending] = []  # to be refused
        self._sending = 0
        self._senders = ThreadPoolExecutor(_SENDERS, "flush-sender")
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="flush")
        self._thread.start()

    def serve_on(self, operations: Operations) -> None:
        """Take the requests of clients from now on."""
        operations.serve(keys.FLUSH, self.add, Lane.ADMINISTRATION)
        operations.queues["flushes"] = lambda: self.queue

    @property
    def queue(self) -> QueueMetrics:
        """Return the state of the queue of pending requests."""
        return QueueMetrics(len(self._pending) + self._sending, self._limit)

    def close(self) -> None:
        """Refuse all pending requests, and end."""
        with self._ledger.changed:
            self._stopping = True
            self._ledger.changed.notify_all()
        self._thread.join()
        self._senders.shutdown()

    def add(self, request: Request) -> None:
        """Take over a flush request; it is answered once its scan is settled.

        Raises:
            RefusedError: it cannot be decoded, a field is out of range, or the server is stopping.
        """
        asks = request.read(FlushRequest)
        self._check(asks)
        now = time.monotonic()
        with self._ledger.changed:
            if self._stopping:
                raise RefusedError("timeout", _STOPPING)
            times = now + ARRIVAL_GRACE_S, now + asks.timeout_s
            self._pending.append(_Pending(request, asks, *times))
            if len(self._pending) + self._sending > self._limit:
                owners = [(entry.request.owner, 1) for entry in self._pending]
                self._excess.append(self._pending.pop(first_to_go(owners)))
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
        if not 0 <= asks.timeout_s <= MAX_FLUSH_S:
            raise RefusedError(
                "bad_request",
                f"timeout_s = {asks.timeout_s} is out of range: use 0 to {MAX_FLUSH_S:g}",
            )

    def _run(self) -> None:
        stopping = False
        while not stopping:
            with self._ledger.changed:
                while not self._stopping:
                    now = time.monotonic()
                    decided = self._decided(now)
                    if decided:
                        break
                    self._ledger.changed.wait(self._time_left_s(now))
                stopping = self._stopping
                if stopping:
                    why = RefusedError("timeout", _STOPPING)
                    decided = [(entry, why) for entry in (*self._pending, *self._excess)]
                self._sending += len(decided)
            for entry, outcome in decided:
                submit(self._senders, self._send, entry, outcome)

    def _send(self, entry: _Pending, outcome: Outcome) -> None:
        try:
            entry.send(outcome, self._warnings)
        finally:
            with self._ledger.changed:
                self._sending -= 1

    def _decided(self, now: float) -> list[tuple[_Pending, Outcome]]:
        """Return the requests that can be answered now, and how; they are no longer pending."""
        busy = RefusedError("busy", f"{self._limit} flush requests are pending already; try later")
        refused: list[tuple[_Pending, Outcome]] = [(entry, busy) for entry in self._excess]
        self._excess = []
        outcomes = [(entry, self._outcome(entry, now)) for entry in self._pending]
        self._pending = [entry for entry, outcome in outcomes if outcome is None]
        if any(self._ledger.is_settled(*entry.scan) for entry in self._pending):
            self._publish_soon()
        return refused + [(entry, outcome) for entry, outcome in outcomes if outcome is not None]

    def _outcome(self, entry: _Pending, now: float) -> Outcome | None:
        """Return the answer to a request; ``None`` if it stays pending."""
        reply = self._ledger.outcome(*entry.scan, overdue=now >= entry.overdue_at)
        if reply is not None or now < entry.deadline:
            return reply
        asks = entry.asks
        return RefusedError(
            "timeout",
            f"scan {asks.sequence} of {asks.source} is not in the map after {asks.timeout_s} s",
        )

    def _time_left_s(self, now: float) -> float | None:
        """Return how long until time alone decides on a request; ``None``: it never does."""
        times = [at for entry in self._pending for at in (entry.overdue_at, entry.deadline)]
        return min((at - now for at in times if at > now), default=None)
