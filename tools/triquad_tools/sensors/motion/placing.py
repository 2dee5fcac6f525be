"""Sweeps placed in the map, each point where it was when it was measured."""

import numpy as np
from triquad_format.records.arrays import Doubles, Longs

from triquad_tools.sensors.motion.frame_tree import FrameTree
from triquad_tools.sensors.sweep import PosedScan, Sweep

_MAX_KNOTS = 2048  # times of a sweep for which poses are computed; more are rounded to them


def place(sweep: Sweep, frames: FrameTree, target: str) -> PosedScan:
    """Return a sweep as a scan in the frame ``target``.

    Where each point has a time, the sensor's motion during the sweep is taken out: the scan is
    what a sensor would have seen that stood where it was in the middle of the sweep.

    Raises:
        NoTransformError: where the sensor was is not known, for the whole of the sweep.
    """
    if sweep.offsets_s is None or len(sweep.points) == 0:
        stamps = np.array([sweep.stamp_ns], np.int64)
        return PosedScan(sweep.points, frames.poses(target, sweep.frame, stamps)[0])
    knots_ns, knot = _knots(sweep.stamp_ns, sweep.offsets_s)
    poses = frames.poses(target, sweep.frame, knots_ns)
    middle = int(np.median(knot))
    relative = np.linalg.inv(poses[middle]) @ poses
    of_points = relative[:, :3].astype(np.float32)[knot]
    turned = np.einsum("nij,nj->ni", of_points[:, :, :3], sweep.points)
    return PosedScan(turned + of_points[:, :, 3], poses[middle])


def _knots(stamp_ns: int, offsets_s: Doubles) -> tuple[Longs, Longs]:
    """Return times [M] for which a pose is needed, and of each point [N] the number of its time."""
    offsets_ns = np.round(offsets_s * 1e9).astype(np.int64)
    low, high = int(offsets_ns.min()), int(offsets_ns.max())
    step = max(1, -(-(high - low) // (_MAX_KNOTS - 1)))
    number = (offsets_ns - low + step // 2) // step
    used = np.zeros(_MAX_KNOTS + 1, bool)
    used[number] = True
    times = np.minimum(stamp_ns + low + np.flatnonzero(used) * step, stamp_ns + high)
    return times, (np.cumsum(used) - 1)[number]
