"""Whether points and places can be those of a sensor on its way: in metres, of one publisher."""

import numpy as np
from numpy.typing import NDArray

from triquad_format.records.arrays import Doubles

_FAR_M = 500.0  # half of the points of no scan are farther away than this: they are in millimetres
_OUTRUN = 3.0
"""As many times its median range a sensor moves at most from scan to scan, as a median. Robots move
0.2, and scanners that are set up by hand 2; in millimetres, a robot that moves 3 cm a scan 4."""

JUMP_M = 0.15  # less than by this, two that publish the same poses may differ
_JUMPS, _SHARE_OF_JUMPS = 5, 0.05  # as many are of two, rather than a few wrong poses of one
_RANGES = 1000  # of a scan, at most, of which the median is taken
_ZERO = np.zeros(3)


def median_range_m(points: NDArray[np.floating], origin: Doubles = _ZERO) -> float:
    """Return how far half of the points [N, 3] are from an origin [3]; 0 where none is finite."""
    ranges = np.linalg.norm(points[:: max(1, len(points) // _RANGES)] - origin, axis=1)
    return float(np.median(np.append(ranges[np.isfinite(ranges)], 0.0)))


def wrong_units(range_m: float, places: Doubles) -> str | None:
    """Return why the points or the poses of scans cannot be in metres; None: they may be.

    Args:
        range_m: the median of the points' ranges.
        places: [N, 3] where the sensor was, scan by scan.
    """
    if range_m > _FAR_M:
        return f"half of the points are farther than {range_m:.0f} m: write them in metres"
    steps_m = np.linalg.norm(np.diff(places, axis=0), axis=1)
    step_m = float(np.median(steps_m)) if len(steps_m) else 0.0
    if not 0 < _OUTRUN * range_m < step_m:
        return None
    return (
        f"from scan to scan the sensor moves {step_m:.0f} m, while half of the points are nearer "
        f"than {range_m:.2g} m: write the positions of the poses in metres, as those of points"
    )


def jumps(times: NDArray[np.integer], places: Doubles, replaced: int = 0) -> tuple[int, float]:
    """Return how often a way jumps to and fro as if two published it, and by how much, metres.

    Args:
        times: [N], increasing.
        places: [N, 3] at these times.
        replaced: places, besides, that another one elsewhere had at the same time.
    """
    share = ((times[1:-1] - times[:-2]) / (times[2:] - times[:-2]))[:, None]
    aside = places[1:-1] - (1 - share) * places[:-2] - share * places[2:]
    # Times that are those of arrival move places along the way, but not off it.
    way, to = places[2:] - places[:-2], places[1:-1] - places[:-2]
    along = (way * to).sum(axis=1) / np.maximum((way * way).sum(axis=1), 1e-30)
    off_way = np.linalg.norm(to - along.clip(0, 1)[:, None] * way, axis=1) > JUMP_M
    size = np.where(off_way, np.linalg.norm(aside, axis=1), 0.0)
    turns_back = (aside[:-1] * aside[1:]).sum(axis=1) < -0.5 * size[:-1] * size[1:]
    found = np.minimum(size[:-1], size[1:])[turns_back]
    found = found[found > JUMP_M]
    count = len(found) + replaced
    if count < max(_JUMPS, _SHARE_OF_JUMPS * (len(times) + replaced)):
        return 0, 0.0
    return count, float(np.median(found)) if len(found) else JUMP_M
