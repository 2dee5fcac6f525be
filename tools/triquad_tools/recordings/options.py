"""What a user may say of a recording; all that is left out is determined from the recording."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

from triquad_client.depth_image import Intrinsics

from triquad_tools.sensors.motion.frame_tree import Transform


@dataclass(frozen=True)
class ReadingOptions:
    """The choices for reading a recording; those for another kind of recording stay unset."""

    topics: tuple[str, ...] = ()  # of clouds or depth images
    poses: str | None = None  # topic of odometry or poses, or "tf"
    map_frame: str | None = None
    body_frame: str | None = None  # whose poses those of the topic are
    transforms: tuple[Transform, ...] = ()  # that the recording lacks
    recorder_clock: bool = False  # stamps are when a message was recorded
    trajectory: Path | None = None  # the file of poses; else that with a usual name
    points_in: Literal["sensor", "world"] | None = None  # frame of clouds; else sensor, and checked
    deskew: bool = True  # take the sensor's motion out of clouds whose points have times
    intrinsics: Intrinsics | None = None  # of depth images; else those of a file in the folder
    units_per_metre: float | None = None  # of a pixel; else 5000 for TUM RGB-D, 1000 for others
    stride: int = 1  # take every N-th row and column of depth images

    @property
    def given(self) -> list[str]:
        """The names of the choices that differ from the defaults."""
        return [field.name for field in fields(self) if getattr(self, field.name) != field.default]
