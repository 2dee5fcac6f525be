"""The scans that a server kept, in one file."""

import os
from pathlib import Path

import numpy as np
from triquad_format.scan_log.segment import LoggedScan, SegmentWriter

from triquad_tools.console.command import ToolError
from triquad_tools.console.progress import progress
from triquad_tools.recordings.scan_log import find_scan_log, read_scan_log


def export_scans(store: Path, output: Path) -> str:
    """Write the scans that are in a map now as a bag of ROS 2; return what it is, and lacks.

    Poses are as they were corrected last, and what was reset is left out.

    Raises:
        ToolError: the store has none, or a file of them cannot be read.
        OSError: the bag cannot be written.
    """
    log = find_scan_log(store)
    if log is None:
        raise ToolError(
            f"{store}: has no scans: a server keeps them with store.log_max_bytes above 0"
        )
    recording = read_scan_log(log)
    entries = recording.entries
    writer = SegmentWriter(output.with_name(f".{output.name}.unfinished"))
    try:
        with progress("writing scans", len(entries)) as report:
            scans = recording.read(range(len(entries)))
            for number, (entry, scan) in enumerate(zip(entries, scans, strict=True), start=1):
                points = np.asarray(scan.points, np.float32)
                missed = np.zeros((0, 3)) if scan.no_return is None else scan.no_return
                missed = np.asarray(missed, np.float32)
                pose = scan.world_from_sensor
                writer.add(LoggedScan(entry.source, entry.stamp_ns, pose, points, missed))
                report(number, f"{number} of {len(entries)} scans")
        writer.finish()
        os.replace(writer.path, output)
    except BaseException:
        writer.discard()
        raise
    sources = len(recording.streams)
    told = f"{output.stat().st_size:,} bytes, {len(entries)} scans of {sources} sources"
    return "; ".join([told, *recording.remarks])
