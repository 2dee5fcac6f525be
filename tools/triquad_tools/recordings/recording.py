"""What recordings tell of their content, whatever kind of file or folder holds them."""

from dataclasses import dataclass

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
