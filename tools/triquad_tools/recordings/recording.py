"""Recordings: scans with poses, whatever kind of file or folder holds them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from triquad_tools.sensors.sweep import PosedScan

DEFAULT_SOURCE = "default"
"""The source of recordings that name no sensor: the client's default, too."""


@dataclass(frozen=True)
class ScanEntry:
    """A scan that can be mapped; its points are read when they are asked for."""

    stamp_ns: int  # nanoseconds since 1970, or since the recording began
    source: str  # name of the sensor, under which its scans are published


@dataclass(frozen=True)
class Stream:
    """One stream of a recording, as ``triquad-replay --list`` shows it."""

    name: str  # of the topic, or of the files
    kind: str  # type of the messages, or of the files
    count: int
    use: str  # in plain words: what is made of it, or why nothing
    frame: str = ""  # of the sensor, or parent and child of poses


class Recording(Protocol):
    """A recording that was checked as a whole, so that its errors are known."""

    @property
    def entries(self) -> Sequence[ScanEntry]:
        """The scans that can be mapped, those of each source in the order of their stamps."""

    @property
    def streams(self) -> Sequence[Stream]:
        """The streams that it holds."""

    @property
    def remarks(self) -> Sequence[str]:
        """The problems: what is left out and why, and what to do about it, a line each."""

    def read(self, indices: Sequence[int]) -> Iterator[PosedScan]:
        """Return the scans of these numbers, which increase, one after the other.

        Raises:
            ToolError: a scan cannot be read.
        """
