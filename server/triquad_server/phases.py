"""The phases of a server's run, and what is done about them; quick to import."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from triquad_server.health import Health
    from triquad_server.self_question import SelfQuestion


class Phases:
    """Hears how a server starts, serves and stops; this one does nothing about it."""

    def starting(self, stage: str) -> None:
        """The start comes to another stage; called before each."""

    def serving(self, health: Health, question: SelfQuestion) -> None:
        """The server serves, until :meth:`stopping`; both arguments tell how it does."""

    def stopping(self) -> None:
        """The server was asked to stop, and what is left to do begins."""
