"""One sweep of a sensor, before and after its pose is known, and errors in such data."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from triquad_format.errors import TriquadError
from triquad_format.records.arrays import Doubles


@dataclass(frozen=True)
class Sweep:
    """A cloud of points, or what a depth image shows, that has no pose yet."""

    points: NDArray[np.floating]  # [N, 3] metres, sensor frame; some may not be finite
    frame: str  # of the sensor, as frames are named in ROS: no leading slash
    stamp_ns: int  # nanoseconds since 1970
    offsets_s: Doubles | None = None  # [N] seconds after the stamp at which each was measured
    note: str = ""  # how it was read, for a user

    @property
    def span_ns(self) -> tuple[int, int]:
        """When its first and its last point were measured, nanoseconds since 1970."""
        offsets = np.zeros(1) if self.offsets_s is None else self.offsets_s
        first, last = offsets.min(initial=0), offsets.max(initial=0)
        return self.stamp_ns + round(first * 1e9), self.stamp_ns + round(last * 1e9)

    @property
    def has_points(self) -> bool:
        """Whether some point is finite."""
        return bool(np.isfinite(self.points).all(axis=1).any())

    @property
    def memory_bytes(self) -> int:
        """The bytes of its arrays."""
        return self.points.nbytes + (0 if self.offsets_s is None else self.offsets_s.nbytes)


@dataclass(frozen=True)
class PosedScan:
    """A scan, and where it was taken."""

    points: NDArray[np.floating]  # [N, 3] metres, sensor frame
    world_from_sensor: Doubles  # [4, 4]
    # [M, 3] directions of rays that met nothing
    no_return: NDArray[np.floating] | None = field(default=None, kw_only=True)

    def seen_from(self, pose: Doubles) -> "PosedScan":
        """Return the same points in the world, as a sensor at another pose [4, 4] has them."""
        points = moved(self.points, np.linalg.inv(pose) @ self.world_from_sensor)
        return replace(self, points=points.astype(np.float32), world_from_sensor=pose)


def moved(points: NDArray[np.floating], pose: NDArray[np.floating]) -> Doubles:
    """Move points [N, 3] by a pose [4, 4], in double precision: they may be far from the origin."""
    return np.asarray(points.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3])


class NoScanError(TriquadError):
    """No scan can be made of a sensor's data; ``reason`` is the short key to count it under."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason

    def __reduce__(self) -> tuple[object, ...]:
        """Let it be sent to another process, with what a subclass adds."""
        return type(self), (self.reason, str(self)), vars(self)


class NoTransformError(NoScanError):
    """The pose of a sensor is not known; ``late`` if transforms that still come may give it."""

    def __init__(self, reason: str, text: str, *, late: bool = False) -> None:
        super().__init__(reason, text)
        self.late = late
