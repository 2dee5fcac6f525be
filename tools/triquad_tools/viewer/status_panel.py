"""The state of the server, in the panel of a page."""

import time

from triquad_client import Client
from triquad_format.wire.messages import ServerStatus

from triquad_tools.console.amounts import duration
from triquad_tools.viewer.page.layer import Layer
from triquad_tools.viewer.page.legends import problem_html, table_html
from triquad_tools.viewer.page.page import Page

_PERIOD_S = 1.0


class StatusPanel(Layer):
    """Shows what the server is doing, and how far away it is."""

    def __init__(self, page: Page, client: Client) -> None:
        super().__init__(page, "Server", _PERIOD_S)
        self._client = client
        with self.folder:
            self.add_text()
        self.start()

    def refresh(self) -> None:
        """Ask the server."""
        asked_s = time.perf_counter()
        status = self._client.status()
        answered_ms = 1e3 * (time.perf_counter() - asked_s)
        problems = (problem_html(text or "") for text in (status.store_error, status.warnings))
        self.tell(table_html(_rows(status, answered_ms)) + "".join(problems))


def _rows(status: ServerStatus, answered_ms: float) -> list[tuple[str, str]]:
    dropped, lost = sum(status.scans_dropped.values()), sum(status.scans_lost.values())
    regions = "1 region" if status.regions == 1 else f"{status.regions} regions"
    learning = f"{status.samples_left / 1e6:.1f} M samples left"
    last, checkpoint = status.last_checkpoint, "none yet"
    if last is not None:
        age = duration(max(0.0, time.time() - last.stamp_ns / 1e9))
        checkpoint = f"epoch {last.epoch}, {last.bytes / 1e6:.1f} MB, {age} ago"
    return [
        ("epoch", f"{status.epoch}"),
        ("learning", "settled: nothing is left to learn" if status.settled else learning),
        ("scans", f"{status.scans_taken:,} taken, {status.scans_waiting} waiting"),
        ("not taken", f"{dropped:,} refused, {lost:,} lost"),
        ("map", f"{regions}, {status.parameters / 1e6:.2f} M parameters"),
        ("memory", f"{status.memory_bytes / 1e6:,.0f} MB"),
        ("last checkpoint", checkpoint),
        ("link", f"answers in {answered_ms:.1f} ms"),
    ]
