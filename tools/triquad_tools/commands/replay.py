"""``triquad-replay``: publish a recording to a map server, or tell what it holds."""

import argparse
import time
from collections.abc import Callable, Sequence
from functools import partial

from triquad_client import Client, FlushReport, connect

from triquad_tools.console.arguments import add_version, positive
from triquad_tools.console.command import FAILED, OK, run
from triquad_tools.console.lines import print_line
from triquad_tools.console.progress import Speed, progress
from triquad_tools.console.report import print_columns
from triquad_tools.console.server_arguments import DEFAULT_MAP, add_server
from triquad_tools.recordings.arguments import add_recording, options_of
from triquad_tools.recordings.opening import open_recording
from triquad_tools.recordings.publishing import (
    FLUSH_TIMEOUT_S,
    keep_few_pending,
    wait_until_settled,
)
from triquad_tools.recordings.recording import ScanEntry
from triquad_tools.recordings.selection import Selection, length_s, open_selected

_COMMAND = "triquad-replay"
_LOOK_PERIOD_S = 1.0  # between questions how many scans were lost

DueTimes = Callable[[Sequence[int]], list[float]]
"""Returns when scans are sent, seconds after the first, by their stamps in nanoseconds."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool: 0 done, 1 scans were lost or refused or the server failed, 2 bad input."""
    options = _parser().parse_args(argv)
    work = _list if options.list else _replay
    interrupted = "interrupted; scans that were sent are in the map"
    return run(_COMMAND, partial(work, options), interrupted=interrupted)


def _list(options: argparse.Namespace) -> int:
    """Print all streams, what is wrong, and how to map it."""
    path = options.recording
    recording = open_recording(path, options_of(options))
    titles = ("stream", "type", "count", "frame", "use")
    rows = [(s.name, s.kind, f"{s.count:,}", s.frame, s.use) for s in recording.streams]
    print_columns(titles, rows, words=("type", "frame", "use"))
    for remark in recording.remarks:
        print_line(remark)
    entries = recording.entries
    if not entries:
        print_line(f"{path}: nothing of it can be mapped as it is")
        return FAILED
    seconds = length_s(entries)
    rate = f", {(len(entries) - 1) / seconds:.1f} a second" if seconds > 0 else ""
    print_line(f"{len(entries):,} scans in {seconds:.1f} s{rate}")
    same = " with the same options" if options_of(options).given else ""
    print_line(f"to map it{same}: triquad-map {path} {path.resolve().stem}.triquad")
    return OK


def _replay(options: argparse.Namespace) -> int:
    selection = open_selected(options)
    with connect(options.connect, options.map or DEFAULT_MAP, config=options.config) as client:
        before = client.status().scans_dropped
        publisher = _Publisher(client, options.source, by_server=options.rate is None)
        publisher.publish(selection, options.rate or _at_once)
        flush = client.flush(FLUSH_TIMEOUT_S)
        seconds = publisher.seconds
        after = client.status().scans_dropped
        refusals = {reason: count - before.get(reason, 0) for reason, count in after.items()}
        rate = f"{seconds:.1f} s, {publisher.published / max(seconds, 1e-9):.1f} scans/s"
        print_line(f"{publisher.summary(flush, refusals)}, {rate}")
        if flush.last_refusal:
            print_line(f"last refusal: {flush.last_refusal}")
        if options.settle:
            status = wait_until_settled(client)
            trained = f"{status.samples_trained / 1e6:.1f} M samples trained"
            print_line(f"settled: epoch {status.epoch}, {trained}")
    return OK if flush.lost == flush.refused == 0 else FAILED


class _Publisher:
    """Sends scans at a pace, and shows progress."""

    def __init__(self, client: Client, source: str | None, *, by_server: bool) -> None:
        """With ``by_server``, the server sets the pace, so that nothing is lost."""
        self._client = client
        self._source = source
        self._by_server = by_server
        self._started = self._next_look = time.monotonic()
        self._lost_before = self._lost_now = self._lost()
        self.published = 0
        self.skipped = 0  # not sent: no point was left of them

    @property
    def seconds(self) -> float:
        """The seconds since the first scan was sent."""
        return time.monotonic() - self._started

    def publish(self, selection: Selection, due_times: DueTimes) -> None:
        """Send all chosen scans, each when it is due."""
        entries, total = selection.entries, len(selection)
        due_s = due_times([entry.stamp_ns for entry in entries])
        with progress("publishing", total) as report:
            for done, scan in enumerate(selection.scans(), start=1):
                entry: ScanEntry = entries[done - 1]
                time.sleep(max(0.0, due_s[done - 1] - self.seconds))
                if len(scan.points):
                    source = self._source or entry.source
                    pose, stamp_s = scan.world_from_sensor, entry.stamp_ns / 1e9
                    self._client.publish_scan(scan.points, pose, stamp_s, source=source)
                    self.published += 1
                    if self._by_server:
                        keep_few_pending(self._client, self.published)
                else:
                    self.skipped += 1
                report(done, self._note(done, total))

    def summary(self, flush: FlushReport, refusals: dict[str, int]) -> str:
        """Return what became of the scans; ``refusals`` are the server's counts by reason."""
        reasons = ", ".join(f"{reason}: {count}" for reason, count in refusals.items() if count > 0)
        parts = [
            f"{self.published} scans published",
            f"{flush.taken} taken",
            f"{flush.refused} refused" + (f" ({reasons})" if flush.refused and reasons else ""),
            f"{flush.lost} lost",
        ]
        if self.skipped:
            parts.append(f"{self.skipped} without points not sent")
        return ", ".join(parts)

    def _note(self, done: int, total: int) -> str:
        if time.monotonic() >= self._next_look:
            self._next_look = time.monotonic() + _LOOK_PERIOD_S
            self._lost_now = self._lost()
        speed = Speed.of(done, total - done, self.seconds)
        rate = f"{speed.per_s:.1f} /s, {self._lost_now - self._lost_before} lost"
        return f"{done} of {total} scans, {rate}, {speed.left_s:.0f} s left"

    def _lost(self) -> int:
        """Return how many scans the server has lost so far, of all sources."""
        return sum(self._client.status().scans_lost.values())


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=_COMMAND,
        description="Publish a recording to a map server. By default the server sets the pace, and "
        "no scan is lost.",
        epilog="Exit status: 0 all scans are in the map (--list: there are some to map), 1 some "
        "were lost or refused or the server failed, 2 wrong usage or input.",
    )
    add_recording(parser)
    add = parser.add_argument
    add("--list", action="store_true", help="tell what the recording holds, and publish nothing")
    add_server(parser)
    add("--source", metavar="NAME", help="publish as this sensor (default: as the recording says)")
    rate = "scans a second, or 1x: as recorded, 2x: twice as fast; whatever the server takes"
    add("--rate", type=due_times, metavar="HZ|FACTORx", help=rate)
    add("--settle", action="store_true", help="wait until the server has learnt all of it")
    add_version(parser)
    return parser


def due_times(text: str) -> DueTimes:
    """Return when scans are due at a rate in Hz, or at a multiple of the recorded pace (``2x``)."""
    factor = positive(text.removesuffix("x"))
    if text.endswith("x"):
        return lambda stamps_ns: [(stamp - stamps_ns[0]) / 1e9 / factor for stamp in stamps_ns]
    return lambda stamps_ns: [number / factor for number in range(len(stamps_ns))]


def _at_once(stamps_ns: Sequence[int]) -> list[float]:
    return [0.0] * len(stamps_ns)
