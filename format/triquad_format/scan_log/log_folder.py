"""The folder of a scan log, in the folder of a map's checkpoints.

A file ``scans-<after>-<epoch>.mcap`` has what the map took in from the last scan of the file that
ends with epoch ``after``, 0 being none, until ``epoch``. So the files before one are found by their
names, and scans that a map no longer has, since it went on from an older checkpoint, are in none
of them. Where the two are equal, something before could not be written, and no file goes on.
"""

import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from triquad_format.mapfile.index import Restored

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


def of_map(found: list[Segment], epoch: int, restored: Restored | None) -> list[Segment]:
    """Return those of some files that a map has, in order.

    Args:
        found: the files, in order.
        epoch: of the checkpoint as which the map is; what it took in later it has lost.
        restored: when it went back to an older checkpoint, the last time.
    """
    left = range(0) if restored is None else range(restored.epoch + 1, restored.as_epoch)
    return [one for one in found if one.epoch <= epoch and one.epoch not in left]


def history(found: list[Segment]) -> list[Segment]:
    """Return the files that the newest of ``found`` goes on from, and itself, the oldest first."""
    return list(_backwards(found))[::-1]


def _backwards(found: list[Segment]) -> Iterator[Segment]:
    by_epoch = {segment.epoch: segment for segment in found}
    epoch = max(by_epoch, default=0)
    while (segment := by_epoch.get(epoch)) is not None:
        yield segment
        if segment.after >= epoch:
            return
        epoch = segment.after
