"""Printing what a recording holds."""

import shlex
from collections.abc import Sequence
from pathlib import Path

from triquad_tools.console.lines import print_line
from triquad_tools.console.report import print_columns
from triquad_tools.recordings.recording import Recording
from triquad_tools.sensors.ros.type_store import IMAGE

_OF_DEPTH = ("depth images", IMAGE)


def print_contents(path: Path, recording: Recording, flags: Sequence[str]) -> bool:
    """Print all streams, what is wrong, and how to map it; whether it can be mapped.

    ``flags`` are those with which it was opened.
    """
    rows = [
        (each.name, each.kind, f"{each.count:,}", each.frame, each.use)
        for each in recording.streams
    ]
    titles = ("stream", "type", "count", "frame", "use")
    print_columns(titles, rows, words=("type", "frame", "use"))
    for remark in recording.remarks:
        print_line(remark)
    entries = recording.entries
    if not entries:
        print_line(f"{path}: nothing of it can be mapped as it is")
        return False
    stamps = [entry.stamp_ns for entry in entries]
    seconds = (max(stamps) - min(stamps)) / 1e9
    rate = f", {(len(entries) - 1) / seconds:.1f} a second" if seconds > 0 else ""
    print_line(f"{len(entries):,} scans in {seconds:.1f} s{rate}")
    if any(stream.kind in _OF_DEPTH and "scans" in stream.use for stream in recording.streams):
        flags = ["--preset", "indoor", *flags]
    command = ["triquad-map", str(path), f"{path.resolve().stem}.triquad", *flags]
    print_line(f"to map it: {shlex.join(command)}")
    return True
