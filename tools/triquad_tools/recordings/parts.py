"""Several bags in one folder: parts of one recording, or drives that do not belong together."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.pose_source import PoseSource
from triquad_tools.recordings.ros_content import SeenCloud

_SLACK_M, _SLACK_S = 1.0, 2.0  # between the parts of a recording the robot goes on as it was


def check_times(clouds: Sequence[SeenCloud]) -> None:
    """Check that the files of clouds follow each other.

    Raises:
        ToolError: two overlap in time.
    """
    for before, after in _seams(clouds):
        over_s = (before[-1].stamp_ns - after[0].stamp_ns) / 1e9
        if over_s > 0:
            raise ToolError(
                f"{before[0].file.name} and {after[0].file.name} overlap by {over_s:.1f} s on "
                f"{after[0].topic}: they are no parts of one recording; map them one by one"
            )


def check_places(clouds: Sequence[SeenCloud], poses: PoseSource) -> None:
    """Check that the robot goes on from file to file of placed clouds where it was.

    Raises:
        ToolError: it jumps between two.
    """
    for before, after in _seams(clouds):
        near = *before[-2:], *after[:2]
        at = len(before[-2:]) - 1  # the step from the one part to the other
        steps_m = np.linalg.norm(np.diff([_place(cloud, poses) for cloud in near], axis=0), axis=1)
        times_s = np.diff([cloud.stamp_ns / 1e9 for cloud in near])
        speeds_m_s = np.delete(steps_m / np.maximum(times_s, 1e-3), at)
        goes_on_s = times_s[at] if times_s[at] <= _SLACK_S else 0.0
        most_m = _SLACK_M + 2 * speeds_m_s.max(initial=0.0) * goes_on_s
        if steps_m[at] > most_m:
            raise ToolError(
                f"{before[0].file.name} and {after[0].file.name}: {times_s[at]:.1f} s lie between "
                f"them, and the robot is {steps_m[at]:.1f} m elsewhere: they are no parts of one "
                "recording; map them one by one, or, where their poses are in one map all the "
                f"same, use --map-frame {poses.target}"
            )


def _seams(clouds: Sequence[SeenCloud]) -> Iterator[tuple[list[SeenCloud], list[SeenCloud]]]:
    """Yield the clouds of each topic in a file and in the one that follows."""
    files: dict[tuple[str, Path], list[SeenCloud]] = defaultdict(list)
    for cloud in clouds:
        files[cloud.topic, cloud.file].append(cloud)
    parts = sorted(files.values(), key=lambda part: (part[0].topic, part[0].stamp_ns))
    return ((a, b) for a, b in pairwise(parts) if a[0].topic == b[0].topic)


def _place(cloud: SeenCloud, poses: PoseSource) -> list[float]:
    stamps = np.array([cloud.stamp_ns], np.int64)
    place: list[float] = poses.frames.poses(poses.target, cloud.frame, stamps)[0, :3, 3].tolist()
    return place
