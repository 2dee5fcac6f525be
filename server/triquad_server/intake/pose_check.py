"""Whether the poses of a source fit its points: a few of its scans are compared, ever fewer."""

from collections import deque

import numpy as np
from triquad_format.records import plausibility
from triquad_format.records.arrays import Doubles
from triquad_format.records.plausibility import ScanView

from triquad_server.intake.rays import ScanRays

_APART_M, _APART_RANGES, _APART_RAD = 5.0, 0.3, 0.3
"""Two scans are compared that lie farther apart than this: metres at most, times how far half of
the points are, or turned by so much."""

_LAG = 5  # scans after which those of one pose are compared, at first: then 10, 20 and 40
_JUDGED, _LEAST = 5, 3  # pairs of scans that tell together: the last ones, and as many at least
_SKIPPED = 64  # scans, after the first pairs: one takes 5 to 15 ms, a scan some 50
_HIDING = 60_000  # points at most, of which some may lie behind others

_REMEDIES = {
    "inverse": "give their inverses, world_from_sensor",
    "wxyz": "give quaternions as x y z w, with w last",
    "xyzw": "they were taken for w x y z: give quaternions as x y z w, with w last",
    "unmoved": "give points in the frame of the sensor; if they are, make rotations of radians, "
    "not of degrees",
    "": "give each scan its own pose, of its time and world_from_sensor, of the sensor and not of "
    "the robot's body, with a rotation made of radians, or of a quaternion x y z w",
}
_ORIGIN = (
    "give points in the frame of the sensor, or set ray_origin_m of the source to where it sits in "
    "theirs"
)


class PoseCheck:
    """Compares scans of a source, and keeps what the newest pairs told."""

    def __init__(self) -> None:
        self._first: ScanView | None = None  # of the next pair
        self._scans = 0  # since that one, or that are still to be skipped, below 0
        self._pairs: deque[Doubles] = deque(maxlen=_JUDGED)
        self._hidden: deque[float] = deque(maxlen=_JUDGED)

    def see(self, rays: ScanRays, rotation: Doubles) -> None:
        """Take notice of a scan, whose sensor is turned by ``rotation`` [3, 3]."""
        self._scans += 1
        if self._scans < 0:
            return
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, rays.origin
        if (first := self._first) is None:
            self._first, self._scans = self._view(rays, pose), 0
            return
        if np.array_equal(first.world_from_sensor, pose):
            due = self._scans >= _LAG << min(_LEAST, len(self._pairs))
        else:
            apart_m = min(_APART_M, _APART_RANGES * first.range_m)
            base = first.world_from_sensor
            due = plausibility.are_apart(base, pose[None], apart_m, _APART_RAD)[0]
        if due:
            self._first, self._scans = self._view(rays, pose), 0
            if (shares := plausibility.shares_before(first, self._first)) is not None:
                self._pairs.append(shares)
            if len(self._hidden) == _JUDGED:
                self._first, self._scans = None, -_SKIPPED

    def misreading(self) -> str | None:
        """Return how poses seem to be meant that fit clearly better so; None: they may be right."""
        told = self._misreading()
        return f"{told[1]}: {_REMEDIES[told[0]]}" if told is not None and told[0] else None

    def problem(self) -> str | None:
        """Return what seems wrong, and what to do about it."""
        told = self._misreading()
        if told is not None:
            return f"{told[1]}: {_REMEDIES[told[0]]}"
        begins = plausibility.hiding(self._hidden) if len(self._hidden) >= _LEAST else None
        return begins and f"{begins}: {_ORIGIN}"

    def _misreading(self) -> tuple[str, str] | None:
        return plausibility.misreading(self._pairs) if len(self._pairs) >= _LEAST else None

    def _view(self, rays: ScanRays, pose: Doubles) -> ScanView:
        points = (rays.ends - rays.origin) @ pose[:3, :3]
        self._hidden.append(plausibility.hidden_share(points[:: max(1, len(points) // _HIDING)]))
        return plausibility.view_of(points, pose)
