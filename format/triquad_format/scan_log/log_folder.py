"""The folder of a scan log, in the folder of a map's checkpoints.

A file ``scans-<after>-<epoch>.mcap`` has what the map took in from the last scan of the file that
ends with epoch ``after``, 0 being none, until ``epoch``. So the files before one are found by their
names, and scans that a map no longer has, since it went on from an older checkpoint, are in none
of them.
"""

import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

LOG_NAME = "scans"
"""The folder of the log, in the folder of the checkpoints."""

_NAME = re.compile(r"scans-([0-9]{9,19})-([0-9]{9,19})\.mcap")


@dataclass(frozen=True, order=True)
class Segment:
    """A file of the log, by its name."""

    epoch: int
    after: int
    path: Path


def segment_name(after: int, epoch: int) -> str:
    """Return the name of a file."""
    return f"scans-{after:09d}-{epoch:09d}.mcap"


def segments(folder: Path) -> list[Segment]:
    """Return all files of a log, the oldest first; none where there is no folder.

    Raises:
        OSError: the folder cannot be read.
    """
    found: list[Segment] = []
    with suppress(FileNotFoundError):
        for path in folder.iterdir():
            if (match := _NAME.fullmatch(path.name)) is not None:
                found.append(Segment(int(match[2]), int(match[1]), path))
    return sorted(found)


def history(found: list[Segment]) -> list[Segment]:
    """Return the files that the newest of ``found`` goes on from, and itself, the oldest first."""
    return list(_backwards(found))[::-1]


def _backwards(found: list[Segment]) -> Iterator[Segment]:
    by_epoch = {segment.epoch: segment for segment in found}
    epoch = max(by_epoch, default=0)
    while (segment := by_epoch.get(epoch)) is not None:
        yield segment
        epoch = min(segment.after, segment.epoch - 1)
