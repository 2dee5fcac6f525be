"""The trajectory of a recording that has none: its lidar's odometry."""

from collections.abc import Iterable
from dataclasses import replace
from itertools import chain, dropwhile, islice
from pathlib import Path

from triquad_tools.console.command import ToolError
from triquad_tools.console.progress import progress
from triquad_tools.odometry.way import Way
from triquad_tools.recordings.folders.trajectory import Trajectory, timed
from triquad_tools.sensors.reach import reach_m
from triquad_tools.sensors.sweep import NoScanError, Sweep

_FIRST = 8  # sweeps from the first with points on, which tell how far the sensor sees


def find_trajectory(sweeps: Iterable[Sweep], count: int, *, close_loops: bool = True) -> Trajectory:
    """Return where a sensor was, as seen from where it was at first.

    Args:
        sweeps: of one sensor, in the order of their stamps.
        count: how many they are.
        close_loops: take into account that it comes back to places.

    Raises:
        ToolError: small_gicp is not installed, there are no points, or a scan does not fit those
            before it.
    """
    numbered = dropwhile(lambda each: not each[1].has_points, enumerate(sweeps, start=1))
    first = list(islice(numbered, _FIRST))
    way = Way(reach_m([sweep.points for _, sweep in first]), close_loops=close_loops)
    with progress("odometry", count) as report:
        for number, sweep in chain(first, numbered):
            try:
                way.add(sweep)
            except NoScanError as error:
                raise ToolError(
                    f"--odometry lost its way at scan {number}: {error}: the sensor moves too far "
                    "from one to the next (map all of them), or sees too little; or give its poses"
                ) from error
            report(number, f"{number} of {count} scans")
    if not len(way):
        raise ToolError("--odometry: no scan has any points")
    stamps_ns, poses = way.trajectory()
    found = timed(Path("odometry"), "VGICP", poses, stamps_ns)
    return replace(found, remarks=tuple(_remarks(way, count)))


def _remarks(way: Way, count: int) -> list[str]:
    """Return how far the poses are to be trusted."""
    told = f"poses are those of odometry, along {way.length_m:.1f} m"
    if way.loops:
        remarks = [
            f"{told}: it came back to known places, {way.loops} times, which moved poses by "
            f"{way.moved_m:.2g} m at most (if these merely look alike: --no-loops)"
        ]
    else:
        remarks = [f"{told}: it drifts, and came back to no place that it knew"]
    if way.loose:
        remarks.append(
            f"{len(way.loose)} of {count} scans, from number {way.loose[0] + 1} on, see "
            "hardly anything that holds them along one direction, as in a tunnel: the way may be "
            "wrong there, too short above all"
        )
    return remarks
