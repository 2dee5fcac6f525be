"""The phases of a server's run, and the hooks called for them; quick to import."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from triquad_server.health import Health
    from triquad_server.self_question import SelfQuestion


class Phases:
    """Receives the phases of a server's run; this one does nothing about them."""

    def starting(self, stage: str) -> None:
        """Report the next stage of the start; called before each."""

    def serving(self, health: Health, question: SelfQuestion) -> None:
        """Report that the server serves, until :meth:`stopping`; both arguments give its state."""

    def stopping(self) -> None:
        """Report that the server was asked to stop, and finishes its work."""
