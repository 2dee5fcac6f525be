"""Folders with a file for each scan, whatever the files hold."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeVar

from triquad_format.records.arrays import Doubles

from triquad_tools.console.progress import progress
from triquad_tools.recordings.recording import DEFAULT_SOURCE, ScanEntry, Stream
from triquad_tools.sensors.sweep import PosedScan

_Read = TypeVar("_Read")


class PlacedFile(NamedTuple):
    """A file, and where and when its scan was taken."""

    path: Path
    stamp_ns: int
    world_from_sensor: Doubles  # [4, 4]


@dataclass(frozen=True)
class ScanFolder:
    """The files of a folder that have poses, in the order of their stamps.

    What a file holds is read when it is asked for.
    """

    files: Sequence[PlacedFile]
    read_file: Callable[[PlacedFile], PosedScan]  # raises a ToolError if it cannot be read
    streams: Sequence[Stream]
    remarks: Sequence[str] = ()  # on files without a pose, and on what else was not used

    def __len__(self) -> int:
        return len(self.files)

    @property
    def entries(self) -> Sequence[ScanEntry]:
        """The entries of all files."""
        return [ScanEntry(file.stamp_ns, DEFAULT_SOURCE) for file in self.files]

    def read(self, indices: Sequence[int]) -> Iterator[PosedScan]:
        """Yield the scans of these numbers.

        Raises:
            ToolError: a file cannot be read; it is named.
        """
        return (self.read_file(self.files[index]) for index in indices)


def check_all(paths: Sequence[Path], read: Callable[[Path], _Read]) -> Iterator[_Read]:
    """Yield what is read of each file, with progress: a damaged one is named before any is used."""
    with progress("looking through the recording", len(paths)) as report:
        for number, path in enumerate(paths, start=1):
            yield read(path)
            report(number, f"{number} of {len(paths)} files")
