"""What of a recording is to be mapped: the arguments that say so, and the scans they choose."""

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from triquad_sensors.sweep import PosedScan

from triquad_tools.console.arguments import count, not_negative, positive
from triquad_tools.console.command import ToolError
from triquad_tools.recordings.cloud import is_withheld, points_in_range
from triquad_tools.recordings.opening import open_recording
from triquad_tools.recordings.recording import Recording, ScanEntry
from triquad_tools.recordings.ros_options import RosOptions, parse_transform

_Add = Callable[..., argparse.Action]


@dataclass(frozen=True)
class Selection:
    """Some scans of a recording, without points that are too near."""

    recording: Recording
    indices: Sequence[int]
    range_min_m: float

    def __len__(self) -> int:
        return len(self.indices)

    @property
    def entries(self) -> list[ScanEntry]:
        """When each was taken, and by which sensor."""
        entries = self.recording.entries
        return [entries[index] for index in self.indices]

    def scans(self, start: int = 0) -> Iterator[PosedScan]:
        """The scans from number ``start`` on, one after the other."""
        for scan in self.recording.read(self.indices[start:]):
            points = points_in_range(np.asarray(scan.points, np.float32), self.range_min_m)
            yield PosedScan(points, scan.world_from_sensor)


def add_recording(parser: argparse.ArgumentParser) -> None:
    """Let a command take a recording, and choose from it."""
    parser.add_argument(
        "recording",
        type=Path,
        metavar="RECORDING",
        help="a bag of ROS 1 or ROS 2, an MCAP file, or a folder of scans (docs/tools.md)",
    )
    _add_choice(parser.add_argument_group("which scans").add_argument)
    _add_ros(parser.add_argument_group("bags and MCAP files").add_argument)


def _add_choice(add: _Add) -> None:
    add("--start", type=not_negative, default=0.0, metavar="S", help="seconds after the first scan")
    add("--end", type=positive, metavar="S", help="seconds after the first scan")
    add("--every", type=count, default=1, metavar="N", help="take every Nth scan of each sensor")
    add(
        "--skip-every",
        type=count,
        default=0,
        metavar="N",
        help="withhold every Nth scan, for triquad-eval --withheld",
    )
    add(
        "--range-min",
        type=not_negative,
        default=0.0,
        metavar="M",
        help="leave out nearer points: the vehicle's own body (default: 0)",
    )


def _add_ros(add: _Add) -> None:
    add(
        "--topics",
        nargs="+",
        default=[],
        metavar="TOPIC",
        help="of clouds or depth images (default: all clouds, or else all depth images)",
    )
    add(
        "--poses",
        metavar="TOPIC",
        help="of odometry or poses, or 'tf' for transforms (default: what places the most scans)",
    )
    add("--map-frame", metavar="FRAME", help="to map in (default: map, odom, world or the root)")
    add("--body-frame", metavar="FRAME", help="whose poses those of --poses are")
    add(
        "--transform",
        action="append",
        default=[],
        metavar="'PARENT CHILD X Y Z QX QY QZ QW'",
        help="that the recording lacks, metres and a quaternion, repeatable",
    )
    add(
        "--recorder-clock",
        action="store_true",
        help="go by when messages were recorded, where their stamps are of different clocks",
    )


def open_selected(options: argparse.Namespace) -> Selection:
    """The recording of the arguments and the scans they choose; its remarks are told.

    Raises:
        ToolError: it cannot be read, or no scan is left to map.
    """
    recording = open_from(options)
    for remark in recording.remarks:
        print(f"{options.recording}: {remark}", file=sys.stderr)
    if not recording.entries:
        raise ToolError(f"{options.recording}: nothing of it can be mapped")
    indices = _chosen(recording.entries, options)
    if not indices:
        raise ToolError(
            f"{options.recording}: no scan is left of {len(recording.entries)} in "
            f"{_length_s(recording.entries):.1f} s: see --start, --end, --every and --skip-every"
        )
    return Selection(recording, indices, options.range_min)


def open_from(options: argparse.Namespace) -> Recording:
    """The recording of the arguments.

    Raises:
        ToolError: it cannot be read, or has not what they name.
    """
    return open_recording(
        options.recording,
        RosOptions(
            topics=tuple(options.topics),
            poses=options.poses,
            map_frame=options.map_frame,
            body_frame=options.body_frame,
            recorder_clock=options.recorder_clock,
            transforms=tuple(map(parse_transform, options.transform)),
        ),
    )


def _chosen(entries: Sequence[ScanEntry], options: argparse.Namespace) -> list[int]:
    """The numbers of the scans within the times, every Nth of each sensor, and not withheld."""
    first_ns = min(entry.stamp_ns for entry in entries)
    end_s = float("inf") if options.end is None else options.end
    numbers: dict[str, int] = {}
    chosen: list[int] = []
    for index, entry in enumerate(entries):
        number = numbers[entry.source] = numbers.get(entry.source, -1) + 1
        after_s = (entry.stamp_ns - first_ns) / 1e9
        if (
            options.start <= after_s <= end_s
            and number % options.every == 0
            and not is_withheld(index, options.skip_every)
        ):
            chosen.append(index)
    return chosen


def _length_s(entries: Sequence[ScanEntry]) -> float:
    stamps = [entry.stamp_ns for entry in entries]
    return (max(stamps) - min(stamps)) / 1e9
