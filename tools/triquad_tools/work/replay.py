"""``triquad-replay``: publish a recording to a map server, or tell what it holds."""

import argparse
import shlex
import time
from pathlib import Path

from triquad_client import FlushReport
from triquad_format.records.arrays import Doubles

from triquad_tools.console.arguments import connect_to
from triquad_tools.console.command import FAILED, OK, print_line
from triquad_tools.console.progress import progress
from triquad_tools.console.report import print_columns
from triquad_tools.recordings.opening import entries_of, length_s, open_recording, open_selected
from triquad_tools.recordings.publishing import FLUSH_TIMEOUT_S, publish_all, wait_until_settled
from triquad_tools.recordings.recording import ScanEntry, options_of
from triquad_tools.sensors.reach import reach_m

_SOME = 8  # scans tell how far a sensor sees
_INDOOR_REACH_M = 12.5  # of the preset


def work(options: argparse.Namespace) -> int:
    """Publish a recording, or tell what it holds."""
    if options.list:
        return _list(options)
    return _correct(options) if options.correct_poses else _replay(options)


def _list(options: argparse.Namespace) -> int:
    (path,) = options.recordings
    recording = open_recording(path, options_of(options))
    titles = ("stream", "type", "count", "frame", "use")
    rows = [(s.name, s.kind, f"{s.count:,}", s.frame, s.use) for s in recording.streams]
    print_columns(titles, rows, words=("type", "frame", "use"))
    for remark in recording.remarks:
        print_line(remark)
    entries = entries_of(recording, path)
    seconds = length_s(entries)
    rate = f", {(len(entries) - 1) / seconds:.1f} a second" if seconds > 0 else ""
    print_line(f"{len(entries):,} scans in {seconds:.1f} s{rate}")
    some = range(0, len(entries), len(entries) // _SOME + 1)
    near_m = reach_m([scan.points for scan in recording.read(some)])
    fits = ["--preset", "indoor"] if near_m < _INDOOR_REACH_M else []
    if fits:
        told = "for rooms, as 95 % of the points are within"
        print_line(f"{' '.join(fits)}, of the server too: {told} {near_m:.1f} m of the sensor")
    words = [word for word in options.arguments if word != "--list"]
    at = next(at for at, word in enumerate(words) if Path(word) == path) + 1
    words = [*words[:at], f"{path.resolve().stem}.triquad", *words[at:], *fits]
    print_line(f"to map it: triquad-map {shlex.join(words)}")
    return OK


def _replay(options: argparse.Namespace) -> int:
    selection = open_selected(options)
    with connect_to(options) as client:
        before = client.status().scans_dropped
        started_s = time.monotonic()
        entries = selection.entries
        due_s = options.rate([entry.stamp_ns for entry in entries]) if options.rate else ()
        sent_as = [ScanEntry(entry.stamp_ns, options.source or entry.source) for entry in entries]
        scans = zip(sent_as, selection.scans(), strict=True)
        published = publish_all(client, scans, len(entries), due_s)
        flush = client.flush(FLUSH_TIMEOUT_S)
        seconds = time.monotonic() - started_s
        after = client.status().scans_dropped
        refusals = {reason: count - before.get(reason, 0) for reason, count in after.items()}
        told = _summary(published, len(selection) - published, flush, refusals)
        print_line(f"{told}, {seconds:.1f} s, {published / max(seconds, 1e-9):.1f} scans/s")
        if flush.last_refusal:
            print_line(f"last refusal: {flush.last_refusal}")
        if options.settle:
            status = wait_until_settled(client)
            trained = f"{status.samples_trained / 1e6:.1f} M samples trained"
            print_line(f"settled: epoch {status.epoch}, {trained}")
    return OK if flush.lost == flush.refused == 0 else FAILED


def _correct(options: argparse.Namespace) -> int:
    """Have the poses of scans that were published before be those that they have now."""
    selection = open_selected(options)
    poses: dict[str, dict[int, Doubles]] = {}  # by source and stamp
    for entry, scan in zip(selection.entries, selection.scans(), strict=True):
        of_source = poses.setdefault(options.source or entry.source, {})
        of_source[entry.stamp_ns] = scan.world_from_sensor
    with connect_to(options) as client:
        for source, known in poses.items():
            stamps_ns = sorted(known)
            with progress(f"correcting poses of {source}"):
                reply = client.correct_poses(
                    source,
                    [stamp_ns / 1e9 for stamp_ns in stamps_ns],
                    [known[stamp_ns] for stamp_ns in stamps_ns],
                )
            print_line(
                f"{source}: {reply.scans_moved} scans moved, {reply.scans_learnt} taken in "
                f"again, epoch {reply.epoch}"
            )
            if reply.undo:
                print_line(reply.undo)
        if options.settle:
            wait_until_settled(client)
    return OK


def _summary(published: int, skipped: int, flush: FlushReport, refusals: dict[str, int]) -> str:
    """Return what became of the scans; ``refusals`` are the server's counts by reason."""
    reasons = ", ".join(f"{reason}: {count}" for reason, count in refusals.items() if count > 0)
    parts = [
        f"{published} scans published",
        f"{flush.taken} taken",
        f"{flush.refused} refused" + (f" ({reasons})" if flush.refused and reasons else ""),
        f"{flush.lost} lost",
    ]
    if skipped:
        parts.append(f"{skipped} without points not sent")
    return ", ".join(parts)
