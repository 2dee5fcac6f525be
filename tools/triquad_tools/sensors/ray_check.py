"""Whether rays begin at the frame of their points, and which points are no rays at all."""

import statistics
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles
from triquad_format.records.plausibility import hidden_share, hiding, median_range_m, wrong_units
from triquad_format.records.pose import moved_pose

from triquad_tools.sensors.sweep import NoScanError, PosedScan

_REPEATED = 16  # equal points of a scan that are no measurements
_NOWHERE = np.empty((0, 3))


def without_repeated(points: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return points [N, 3] without those that many are equal to.

    Drivers and nodes that move clouds into another frame leave rays without a return at the place
    of the sensor.
    """
    x = np.sort(points[:, 0])
    suspects = np.flatnonzero(np.isin(points[:, 0], x[_REPEATED:][x[_REPEATED:] == x[:-_REPEATED]]))
    if not len(suspects):  # as nearly always: points that differ seldom have the same x
        return points
    _, number, counts = np.unique(points[suspects], axis=0, return_inverse=True, return_counts=True)
    return np.delete(points, suspects[counts[number.ravel()] > _REPEATED], axis=0)


def as_rays(scan: PosedScan, origin: Sequence[float]) -> PosedScan:
    """Return a scan without repeated points, whose rays begin at an origin [3] in its frame."""
    points = without_repeated(np.asarray(scan.points, np.float32))
    scan = replace(scan, points=points)
    if not any(origin):
        return scan
    pose = scan.world_from_sensor
    return scan.seen_from(moved_pose(pose, pose[:3, :3] @ origin))


class RayCheck:
    """Looks at some scans of each stream, ever fewer the more there are."""

    def __init__(self) -> None:
        self._seen: Counter[str] = Counter()
        self._shares: dict[str, list[float]] = defaultdict(list)
        self._ranges_m: dict[str, list[float]] = defaultdict(list)

    def see(self, stream: str, points: NDArray[np.floating], *, is_depth: bool = False) -> None:
        """Take notice of the points [N, 3] of a scan, in the frame in which its rays begin.

        Those of a depth image begin at its camera.
        """
        self._seen[stream] += 1
        if self._seen[stream].bit_count() == 1:  # the first, the second, fourth, eighth, ...
            share = 0.0 if is_depth else hidden_share(without_repeated(points))
            self._shares[stream].append(share)
            self._ranges_m[stream].append(median_range_m(points))

    def problem(self, stream: str, places: Doubles = _NOWHERE) -> NoScanError | None:
        """Return why points of a stream cannot be metres seen from 0, 0, 0; None: they may.

        ``places`` [N, 3] are where the sensor was, scan by scan, as far as that is known.
        """
        range_m = statistics.median(self._ranges_m[stream] or [0.0])
        if (told := wrong_units(range_m, places)) is not None:
            return NoScanError("units", told)
        told = hiding(self._shares[stream])
        return None if told is None else NoScanError("ray_origin", told)
