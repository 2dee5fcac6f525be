"""``triquad-replay``: publish a recording to a map server."""

import argparse
import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from triquad_client import Client, FlushReport, connect

from triquad_tools.console.arguments import add_version, positive
from triquad_tools.console.command import FAILED, OK, run
from triquad_tools.console.lines import print_line
from triquad_tools.console.progress import Speed, progress
from triquad_tools.console.server_arguments import DEFAULT_MAP, add_server
from triquad_tools.recordings.arguments import add_recording, flags_of, options_of
from triquad_tools.recordings.listing import print_contents
from triquad_tools.recordings.opening import open_recording
from triquad_tools.recordings.publishing import (
    FLUSH_TIMEOUT_S,
    keep_few_pending,
    wait_until_settled,
)
from triquad_tools.recordings.recording import ScanEntry
from triquad_tools.recordings.selection import Selection, open_selected
from triquad_tools.sensors.sweep import PosedScan

_COMMAND = "triquad-replay"
_LOOK_PERIOD_S = 1.0  # between questions how many scans were lost


@dataclass(frozen=True)
class Pace:
    """The times of sending; by default as soon as the server has integrated the scans before."""

    rate_hz: float | None = None
    speed: float | None = None  # times the pace at which they were taken

    @property
    def by_server(self) -> bool:
        """Whether the server sets the pace: nothing is lost then."""
        return self.rate_hz is None and self.speed is None

    def due_s(self, stamps_ns: Sequence[int]) -> list[float]:
        """Return when each scan is to be sent, seconds after the first."""
        if self.speed is not None:
            return [(stamp - stamps_ns[0]) / 1e9 / self.speed for stamp in stamps_ns]
        period_s = 0.0 if self.rate_hz is None else 1.0 / self.rate_hz
        return [index * period_s for index in range(len(stamps_ns))]


@dataclass(frozen=True)
class ReplayReport:
    """The outcome of a replay."""

    published: int
    skipped: int  # not sent: no point was left of them
    flush: FlushReport
    refusals: dict[str, int]  # on the server meanwhile, by reason
    seconds: float  # until the server had integrated all

    @property
    def complete(self) -> bool:
        """Whether every scan is in the map."""
        return self.flush.lost == self.flush.refused == 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool: 0 done, 1 scans were lost or refused or the server failed, 2 bad input."""
    work = partial(_replay, _parser().parse_args(argv))
    return run(_COMMAND, work, interrupted="interrupted; scans that were sent are in the map")


def _replay(options: argparse.Namespace) -> int:
    if options.list:
        recording = open_recording(options.recording, options_of(options))
        mappable = print_contents(options.recording, recording, flags_of(options))
        return OK if mappable else FAILED
    selection = open_selected(options)
    with connect(options.connect, options.map or DEFAULT_MAP, config=options.config) as client:
        report = _publish_all(client, selection, options)
        print_line(_summary(report))
        if options.settle:
            status = wait_until_settled(client)
            trained = f"{status.samples_trained / 1e6:.1f} M samples trained"
            print_line(f"settled: epoch {status.epoch}, {trained}")
    return OK if report.complete else FAILED


def _publish_all(client: Client, selection: Selection, options: argparse.Namespace) -> ReplayReport:
    """Publish the chosen scans and wait until the server has dealt with them."""
    before = client.status().scans_dropped
    publisher = _Publisher(client, options.pace, options.source)
    rounds = itertools.count() if options.loop else range(1)
    for number in rounds:
        publisher.play(selection, number)
    flush = client.flush(FLUSH_TIMEOUT_S)
    seconds = publisher.seconds
    after = client.status().scans_dropped
    refusals = {reason: count - before.get(reason, 0) for reason, count in after.items()}
    refusals = {reason: count for reason, count in refusals.items() if count > 0}
    return ReplayReport(
        publisher.published, publisher.skipped, flush, refusals=refusals, seconds=seconds
    )


class _Publisher:
    """Sends scans at a pace, and shows progress."""

    def __init__(self, client: Client, pace: Pace, source: str | None) -> None:
        self._client = client
        self._pace = pace
        self._source = source
        self._started = time.monotonic()
        self._lost_before = self._lost_now = _lost(client)
        self._next_look = self._started
        self.published = 0
        self.skipped = 0

    @property
    def seconds(self) -> float:
        """The seconds since the first scan was sent."""
        return time.monotonic() - self._started

    def play(self, selection: Selection, number: int) -> None:
        """Send all chosen scans, which go on in time after ``number`` rounds before."""
        entries = selection.entries
        stamps = [entry.stamp_ns for entry in entries]
        length_ns = max(stamps) - min(stamps)
        round_ns = length_ns + length_ns // max(1, len(stamps) - 1)
        due_s = self._pace.due_s(stamps)
        began_s = self.seconds
        with progress("publishing", len(selection)) as report:
            for done, (entry, scan) in enumerate(zip(entries, selection.scans(), strict=True)):
                time.sleep(max(0.0, began_s + due_s[done] - self.seconds))
                self._send(entry, scan, entry.stamp_ns + number * round_ns)
                report(done + 1, self._note(done + 1, len(selection), self.seconds - began_s))

    def _send(self, entry: ScanEntry, scan: PosedScan, stamp_ns: int) -> None:
        if len(scan.points) == 0:
            self.skipped += 1
            return
        source = self._source or entry.source
        self._client.publish_scan(
            scan.points, scan.world_from_sensor, stamp_ns / 1e9, source=source
        )
        self.published += 1
        if self._pace.by_server:
            keep_few_pending(self._client, self.published)

    def _note(self, done: int, total: int, seconds: float) -> str:
        speed = Speed.of(done, total - done, seconds)
        if time.monotonic() >= self._next_look:
            self._next_look = time.monotonic() + _LOOK_PERIOD_S
            self._lost_now = _lost(self._client)
        lost = self._lost_now - self._lost_before
        rate = f"{speed.per_s:.1f} /s, {lost} lost, {speed.left_s:.0f} s left"
        return f"{done} of {total} scans, {rate}"


def _lost(client: Client) -> int:
    """Return how many scans the server has lost so far, of all sources."""
    return sum(client.status().scans_lost.values())


def _summary(report: ReplayReport) -> str:
    flush = report.flush
    rate_hz = report.published / max(report.seconds, 1e-9)
    reasons = ", ".join(f"{reason}: {count}" for reason, count in report.refusals.items())
    parts = [
        f"{report.published} scans published",
        f"{flush.taken} taken",
        f"{flush.refused} refused" + (f" ({reasons})" if flush.refused and reasons else ""),
        f"{flush.lost} lost",
    ]
    if report.skipped:
        parts.append(f"{report.skipped} without points not sent")
    line = f"{', '.join(parts)}, {report.seconds:.1f} s, {rate_hz:.1f} scans/s"
    if flush.last_refusal:
        line += f"\nlast refusal: {flush.last_refusal}"
    return line


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
    pace = parser.add_mutually_exclusive_group()
    pace.add_argument(
        "--rate",
        dest="pace",
        type=_pace,
        default=Pace(),
        metavar="HZ|FACTORx",
        help="scans a second, or 2x: twice as fast as recorded; whatever the server takes",
    )
    pace.add_argument(
        "--as-recorded",
        dest="pace",
        action="store_const",
        const=Pace(speed=1.0),
        help="--rate 1x; folders without times are taken as 10 Hz",
    )
    add("--loop", action="store_true", help="begin again at the end, until Ctrl-C")
    add("--settle", action="store_true", help="wait until the server has learnt all of it")
    add_version(parser)
    return parser


def _pace(text: str) -> Pace:
    if text.endswith("x"):
        return Pace(speed=positive(text[:-1]))
    return Pace(rate_hz=positive(text))
