"""Whether scans and their poses can be true: units, ways, and agreement with each other.

A direction in which a sensor looks has one return. From elsewhere, from the robot's base on the
ground or from the map's origin, rays to the same points pass through other points: the ground lies
behind itself, rooms behind their walls. So do points whose columns are not x, y and z.

Points of another scan may lie behind what this one saw, which hid them, but not clearly before it.
Where many do, the poses are meant otherwise, or are wrong.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from triquad_format.records.arrays import Bools, Doubles, Floats, Longs
from triquad_format.records.pose import pose_matrices, quaternion_of

_FAR_M = 500.0  # half of the points of no scan are farther away than this: they are in millimetres
_OUTRUN = 3.0
"""As many times its median range a sensor moves at most from scan to scan, as a median. Robots move
0.2, and scanners that are set up by hand 2; in millimetres, a robot that moves 3 cm a scan 4."""

JUMP_M = 0.15  # less than by this, two that publish the same poses may differ
_JUMPS, _SHARE_OF_JUMPS = 5, 0.05  # as many are of two, rather than a few wrong poses of one
_RANGES = 1000  # of a scan, at most, of which the median is taken
_ZERO = np.zeros(3)

_BIN_RAD = np.radians(0.25)  # side of the cells of direction that are compared: one ray of lidars
_BEHIND = 1.5  # a point lies behind another in its direction if it is this many times as far
_HIDDEN = 0.07
"""The share of points behind others from which on rays begin elsewhere.

From the sensor it is 0.3 % in streets and halls and up to 5 % amid trees; from the base of a car
on the ground 8 to 23 %, from the origin of a map 7 to 21 % (recorded and simulated drives)."""

_CELL_RAD = np.radians(2.0)  # the same of two scans: beams of lidars are at most as far apart
_CELLS = 91 * 181  # of these
_BEFORE = 1.3  # a point lies before what another scan saw if that is this many times as far
_NEAREST_M = 0.3  # nearer points are the robot's own
_SEEN, _COMPARED = 20_000, 2_000  # points of a scan: that show what it saw, and of these the others

_IN_VIEW, _NEAR_RANGES = 0.2, 2.0
"""The share of the points in view of another scan, and how far apart the scans are at most, times
how far half of the points are: else they show different places, all of which lies behind."""

_WRONG, _UNEXPLAINED, _CLEARLY = 0.05, 0.1, 3.0
"""The shares of points before others from which on poses are wrong: where they are _CLEARLY times
as much as if the poses are meant otherwise, and where nothing explains them.

By right poses they are under 1 % in streets, a room, a hall and two real drives, and up to 4 % amid
traffic, people and rain; by wrong ones 5 to 40 % wherever the way or the surroundings turn."""

_SAID = ""


@dataclass(frozen=True)
class ScanView:
    """What a scan saw from where it was taken, and some of its points."""

    world_from_sensor: Doubles  # [4, 4]
    points: Doubles  # [N, 3] metres, sensor frame
    nearest_m: Floats  # in each cell of direction; not a number where it saw nothing
    range_m: float  # how far half of the points are


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


def are_apart(pose: Doubles, others: Doubles, apart_m: float, apart_rad: float) -> Bools:
    """Return whether each of other poses [N, 4, 4] lies or is turned farther from one [4, 4]."""
    steps = np.linalg.inv(pose) @ others
    turns = np.arccos(np.clip((np.trace(steps[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
    return np.asarray((turns > apart_rad) | (np.linalg.norm(steps[:, :3, 3], axis=1) > apart_m))


def hidden_share(points: NDArray[np.floating]) -> float:
    """Return which share of points [N, 3], metres, lies behind others, seen from 0, 0, 0."""
    ranges = np.linalg.norm(points, axis=1)
    used = np.isfinite(ranges) & (ranges > _NEAREST_M)
    cells, ranges = _cells(points[used], _BIN_RAD)
    _, cells = np.unique(cells, return_inverse=True)
    nearest = np.full(len(cells), np.inf)
    np.minimum.at(nearest, cells, ranges)
    return float(np.mean(ranges > _BEHIND * nearest[cells])) if len(cells) else 0.0


def hiding(shares: Sequence[float]) -> str | None:
    """Return why rays begin elsewhere, of whose scans such shares are hidden; None: they may not.

    That is told by the median of the shares.
    """
    share = float(np.median(shares)) if shares else 0.0
    if share <= _HIDDEN:
        return None
    return (
        f"{share:.0%} of the points lie behind others as seen from the origin of their frame, so "
        "their rays begin elsewhere"
    )


def view_of(points: NDArray[np.floating], world_from_sensor: Doubles) -> ScanView:
    """Return what a scan with points [N, 3] of its sensor's frame saw."""
    seen = points[:: max(1, len(points) // _SEEN)].astype(np.float64)
    seen = seen[np.linalg.norm(seen, axis=1) > _NEAREST_M]  # none that is not a number
    cells, ranges = _cells(seen, _CELL_RAD)
    nearest_m = np.full(_CELLS, np.inf)
    np.minimum.at(nearest_m, cells, ranges)
    nearest_m = np.where(nearest_m < np.inf, nearest_m, np.nan).astype(np.float32)
    some = seen[:: max(1, len(seen) // _COMPARED)]
    return ScanView(world_from_sensor, some, nearest_m, median_range_m(some))


def shares_before(first: ScanView, second: ScanView) -> Doubles | None:
    """Return which share of two scans' points lies before what the other one saw.

    By the poses as they are said, then by each of the other readings, 1 where these show different
    places; None where the poses as they are said do.
    """
    poses, shares = np.array([first.world_from_sensor, second.world_from_sensor]), []
    for name, (read, _) in _READINGS.items():
        of_first, of_second = read(poses)
        step = np.linalg.inv(of_first) @ of_second
        before, in_view = _before(first, second, step) + _before(second, first, np.linalg.inv(step))
        seen = in_view > _IN_VIEW * (len(first.points) + len(second.points))
        seen &= np.linalg.norm(step[:3, 3]) < _NEAR_RANGES * first.range_m
        if name == _SAID and not seen:
            return None
        shares.append(before / in_view if seen else 1.0)
    return np.array(shares)


def misreading(shares: Sequence[Doubles]) -> tuple[str, str] | None:
    """Return how poses seem to be meant, and why they seem wrong; None: they may be right.

    ``shares`` are those of pairs of scans. The key of the reading is empty if none fits.
    """
    if not shares:
        return None
    said, *others = np.median(shares, axis=0).tolist()
    other, name = min(zip(others, list(_READINGS)[1:], strict=True))
    name = name if said > _CLEARLY * other else _SAID
    if said < (_WRONG if name else _UNEXPLAINED):
        return None
    told = f"{_READINGS[name][1]}: by them {said:.0%} of the points of a scan lie where another"
    return name, f"{told} one saw through" + (f", and {other:.1%} if taken so" if name else "")


def _cells(points: NDArray[np.floating], side_rad: float) -> tuple[Longs, NDArray[np.floating]]:
    """Return the cell of direction and the range of points [N, 3]."""
    ranges = np.linalg.norm(points, axis=1)
    azimuth = np.rint((np.arctan2(points[:, 1], points[:, 0]) + np.pi) / side_rad)
    up = np.rint((np.arcsin(points[:, 2] / np.maximum(ranges, 1e-9)) + np.pi / 2) / side_rad)
    return (azimuth * (round(np.pi / side_rad) + 1) + up).astype(np.int64), ranges


def _before(seer: ScanView, other: ScanView, seer_from_other: Doubles) -> Longs:
    """Return how many points of another scan lie before what one saw, and how many in its view."""
    moved = other.points @ seer_from_other[:3, :3].T + seer_from_other[:3, 3]
    cells, ranges = _cells(moved, _CELL_RAD)
    nearest_m = seer.nearest_m[cells]
    return np.array([(_BEFORE * ranges < nearest_m).sum(), np.isfinite(nearest_m).sum()])


def _reordered(shift: int, poses: Doubles) -> Doubles:
    """Return poses [N, 4, 4] whose quaternions have w at their other end."""
    turns = np.array([np.roll(quaternion_of(pose[:3, :3]), shift) for pose in poses])
    return pose_matrices(poses[:, :3, 3], turns)


_READINGS: dict[str, tuple[Callable[[Doubles], NDArray[np.floating]], str]] = {
    _SAID: (lambda poses: poses, "the poses do not fit the points"),
    "inverse": (lambda poses: np.linalg.inv(poses), "the poses seem to be sensor_from_world"),
    "wxyz": (partial(_reordered, -1), "the poses seem to have quaternions w x y z"),
    "xyzw": (partial(_reordered, 1), "the poses seem to have quaternions x y z w"),
    "unmoved": (
        lambda poses: np.tile(np.eye(4), (len(poses), 1, 1)),
        "the points fit each other as if they were in the map frame already",
    ),
}
"""How poses may be meant: the poses as they are meant, and how that is told."""
