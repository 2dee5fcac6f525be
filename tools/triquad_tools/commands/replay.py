"""``triquad-replay``: publish a recorded folder of scans to a map server."""

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from triquad_client import Client, FlushReport, connect
from triquad_format.wire.endpoints import DEFAULT_ENDPOINT

from triquad_tools.console.arguments import add_version, count, not_negative, positive
from triquad_tools.console.command import FAILED, OK, ToolError, run
from triquad_tools.console.progress import progress
from triquad_tools.recordings.cloud import is_withheld, points_in_range
from triquad_tools.recordings.kitti import KittiFolder, read_folder
from triquad_tools.recordings.publishing import (
    FLUSH_TIMEOUT_S,
    keep_few_pending,
    wait_until_settled,
)

_COMMAND = "triquad-replay"


@dataclass(frozen=True)
class Pace:
    """When scans are sent; by default as soon as the server has taken in those before."""

    rate_hz: float | None = None
    as_recorded: bool = False

    @property
    def by_server(self) -> bool:
        """Whether the server sets the pace: nothing is lost then."""
        return self.rate_hz is None and not self.as_recorded


@dataclass(frozen=True)
class ReplayReport:
    """What became of the scans."""

    published: int
    skipped: int  # not sent: no point was left of them
    flush: FlushReport
    refusals: dict[str, int]  # on the server meanwhile, by reason
    seconds: float  # until the server had taken in all

    @property
    def complete(self) -> bool:
        """Whether every scan is in the map."""
        return self.flush.lost == self.flush.refused == 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool: 0 done, 1 scans were lost or refused or the server failed, 2 bad input."""
    work = partial(_replay, _parser().parse_args(argv))
    return run(_COMMAND, work, interrupted="interrupted; scans that were sent are in the map")


def _replay(options: argparse.Namespace) -> int:
    folder = read_folder(options.folder)
    indices = [i for i in range(len(folder)) if not is_withheld(i, options.skip_every)]
    if not indices:
        raise ToolError(f"{options.folder}: --skip-every {options.skip_every} leaves no scan")
    with connect(options.connect, options.map) as client:
        report = _publish_all(client, folder, indices, options=options)
        print(_summary(report))
        if options.settle:
            status = wait_until_settled(client)
            trained = f"{status.samples_trained / 1e6:.1f} M samples trained"
            print(f"settled: epoch {status.epoch}, {trained}")
    return OK if report.complete else FAILED


def _publish_all(
    client: Client, folder: KittiFolder, indices: Sequence[int], options: argparse.Namespace
) -> ReplayReport:
    """Publish the scans ``indices`` and wait until the server has dealt with them."""
    pace = Pace(options.rate, options.as_recorded)
    before = client.status().scans_dropped
    due_s = due_times(pace, [int(folder.stamps_ns[index]) for index in indices])
    published = skipped = 0
    started = time.monotonic()
    with progress("publishing", len(indices)) as report:
        for done, index in enumerate(indices):
            time.sleep(max(0.0, started + due_s[done] - time.monotonic()))
            points = points_in_range(folder.read_points(index), options.range_min)
            if len(points):
                stamp_s = int(folder.stamps_ns[index]) / 1e9
                client.publish_scan(points, folder.poses[index], stamp_s, source=options.source)
                published += 1
                if pace.by_server:
                    keep_few_pending(client, published)
            else:
                skipped += 1
            report(done + 1, f"{done + 1} of {len(indices)} scans")
        flush = client.flush(FLUSH_TIMEOUT_S)
    seconds = time.monotonic() - started
    after = client.status().scans_dropped
    refusals = {reason: count - before.get(reason, 0) for reason, count in after.items()}
    refusals = {reason: count for reason, count in refusals.items() if count > 0}
    return ReplayReport(published, skipped, flush, refusals=refusals, seconds=seconds)


def due_times(pace: Pace, stamps_ns: Sequence[int]) -> list[float]:
    """When each scan is to be sent, seconds after the first."""
    if pace.as_recorded:
        return [(stamp - stamps_ns[0]) / 1e9 for stamp in stamps_ns]
    period_s = 0.0 if pace.rate_hz is None else 1.0 / pace.rate_hz
    return [index * period_s for index in range(len(stamps_ns))]


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
        description="Publish a KITTI-style folder of scans to a map server. By default the server "
        "sets the pace, and no scan is lost.",
        epilog="Exit status: 0 all scans are in the map, 1 some were lost or refused or the "
        "server failed, 2 wrong usage or input.",
    )
    add = parser.add_argument
    add("folder", type=Path, metavar="FOLDER", help="poses.txt, scans and perhaps times.txt")
    add(
        "--connect",
        default=DEFAULT_ENDPOINT,
        metavar="ENDPOINT",
        help=f"of the server (default: {DEFAULT_ENDPOINT})",
    )
    add("--map", default="default", metavar="NAME", help="default: default")
    add("--source", default="default", metavar="NAME", help="name of the sensor (default: default)")
    pace = parser.add_mutually_exclusive_group()
    pace.add_argument(
        "--rate", type=positive, metavar="HZ", help="scans a second, whatever the server takes"
    )
    pace.add_argument(
        "--as-recorded", action="store_true", help="at the times in times.txt (10 Hz without it)"
    )
    add(
        "--skip-every",
        type=count,
        default=0,
        metavar="N",
        help="withhold every Nth scan, for triquad-eval --withheld",
    )
    add(
        "--range-min",
        type=not_negative,
        default=0.0,
        metavar="M",
        help="do not send nearer points: the vehicle's own body (default: 0)",
    )
    add("--settle", action="store_true", help="wait until the server has learnt all of it")
    add_version(parser)
    return parser
