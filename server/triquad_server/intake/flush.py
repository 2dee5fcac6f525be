"""Answers queries of what became of scans, and whether the newest epoch shows them."""

from collections.abc import Callable
from dataclasses import replace

from triquad_format.wire.messages import FlushReply, FlushRequest

from triquad_server.intake.source_ledger import SourceLedger

ARRIVAL_GRACE_S = 2.0
"""A scan that has not arrived this many seconds after the first flush request, which travels the
same way behind it, is lost."""


class FlushQueries:
    """Answers flush requests at once: a publisher asks again until all is done."""

    def __init__(
        self,
        ledger: SourceLedger,
        publish_soon: Callable[[], None],
        warnings: Callable[[str], str | None] = lambda _: None,
    ) -> None:
        """Make the handler; ``publish_soon`` requests an epoch from the mapper.

        ``warnings`` returns those about a source.
        """
        self._ledger = ledger
        self._publish_soon = publish_soon
        self._warnings = warnings

    def answer(self, request: FlushRequest) -> FlushReply:
        """Return what became of the scans of a session."""
        scan = request.source, request.session, request.sequence
        reply = self._ledger.outcome(*scan, overdue=request.waited_s >= ARRIVAL_GRACE_S)
        if not reply.done:
            if self._ledger.is_settled(*scan):
                self._publish_soon()
            return reply
        lines = filter(None, (reply.warnings, self._warnings(request.source)))
        return replace(reply, warnings="\n".join(lines) or None)
