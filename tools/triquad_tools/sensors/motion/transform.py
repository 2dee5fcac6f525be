"""The pose of one frame in another, as robots report it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from triquad_client.pose import Pose

STATIC = None  # the stamp of a transform that always holds
_NEARLY_UNIT = 1e-6  # the length of a quaternion that is left as it is


@dataclass(frozen=True)
class Transform:
    """The pose of a frame in its parent."""

    parent: str
    child: str
    stamp_ns: int | None  # nanoseconds since 1970, or STATIC
    pose: Pose

    def numbers(self) -> tuple[Sequence[float], Sequence[float]]:
        """Return the position [3] and the unit quaternion [4].

        Raises:
            InvalidScanError: its pose is none.
        """
        position, turn = self.pose.position_m, self.pose.quaternion_xyzw
        if (
            isinstance(position, tuple)  # as transforms come, a thousand a second
            and isinstance(turn, tuple)
            and abs(math.hypot(*turn) - 1) < _NEARLY_UNIT
            and math.isfinite(sum(position))
        ):
            return position, turn
        checked = self.pose.numbers()
        return checked[0].tolist(), checked[1].tolist()
