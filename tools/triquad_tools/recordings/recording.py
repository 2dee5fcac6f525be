"""What a user may say of a recording, and what it tells, whatever kind of file or folder it is."""

import argparse
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

from triquad_client.depth_image import Intrinsics

from triquad_tools.console.arguments import Place
from triquad_tools.sensors.motion.track import Transform
from triquad_tools.sensors.sweep import NoScanError

DEFAULT_SOURCE = "default"  # of recordings that name no sensor: the client's default, too

_ORIGIN_REMEDIES = (
    "--ray-origin X,Y,Z says where the sensor sits in it (metres; 0,0,0 if that is right); of "
    "clouds that were merged, map those of each sensor; points in a frame that stands still need "
    "--points-in world"
)


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


@dataclass(frozen=True)
class ReadingOptions:
    """The choices for reading a recording; those for another kind of recording stay unset."""

    topics: tuple[str, ...] = ()  # of clouds or depth images
    poses: str | None = None  # topic of odometry or poses, or "tf"
    map_frame: str | None = None
    body_frame: str | None = None  # whose poses those of the topic are
    transforms: tuple[Transform, ...] = ()  # that the recording lacks
    recorder_clock: bool = False  # stamps are when a message was recorded
    trajectory: Path | None = None  # the file of poses; else that with a usual name, or of the bag
    odometry: bool = False  # find the poses by the clouds alone
    loops: bool = True  # and by the places that they come back to
    quaternion: Literal["xyzw", "wxyz"] | None = None  # order in it; else as its form has it
    points_in: Literal["sensor", "world"] | None = None  # frame of clouds; else sensor, and checked
    ray_origin: Place | None = None  # of clouds, in their frame; else its origin, and checked
    columns: tuple[str, ...] | None = None  # of .bin clouds; else as KITTI has them, and checked
    deskew: bool = True  # take the sensor's motion out of clouds whose points have times
    intrinsics: Intrinsics | None = None  # of depth images; else those of a file in the folder
    units_per_metre: float | None = None  # of a pixel; else 5000 for TUM RGB-D, 1000 for others
    stride: int = 1  # take every N-th row and column of depth images


def with_remedies(problem: NoScanError | None) -> NoScanError | None:
    """Return what is wrong with the points of a recording, with what to do about it."""
    if problem is None or problem.reason != "ray_origin":
        return problem
    return NoScanError(problem.reason, f"{problem}: {_ORIGIN_REMEDIES}")


def options_of(options: argparse.Namespace) -> ReadingOptions:
    """Return how the arguments want a recording to be read."""
    values = {field.name: getattr(options, field.name) for field in fields(ReadingOptions)}
    for name in ("topics", "transforms"):
        values[name] = tuple(values[name])
    return ReadingOptions(**values)
