"""The arguments of commands that take a recording."""

import argparse
from collections.abc import Callable
from pathlib import Path

from triquad_client.depth_image import Intrinsics

from triquad_tools.console.arguments import count, not_negative, positive
from triquad_tools.console.command import ToolError
from triquad_tools.recordings.folders.cloud_folder import CloudOptions
from triquad_tools.recordings.folders.depth_folder import DepthOptions
from triquad_tools.recordings.opening import RecordingOptions
from triquad_tools.recordings.ros_options import RosOptions, parse_transform
from triquad_tools.sensors.ros.header import frame_name

_Add = Callable[..., argparse.Action]

_VALUES = (
    "poses",
    "map_frame",
    "body_frame",
    "trajectory",
    "points_in",
    "intrinsics",
    "units_per_metre",
    "stride",
)
"""Arguments with a value that say how a recording is read; None where they are not given."""


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
    _add_folder(parser.add_argument_group("folders of clouds or depth images").add_argument)


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


def _add_folder(add: _Add) -> None:
    add("--trajectory", type=Path, metavar="FILE", help="of poses (default: one with a usual name)")
    add(
        "--points-in",
        choices=("sensor", "world"),
        help="frame of the points of clouds (default: sensor, and checked)",
    )
    add(
        "--no-deskew", action="store_true", help="clouds are free of motion, though they have times"
    )
    add(
        "--intrinsics",
        metavar="FX,FY,CX,CY",
        help="of the depth camera, pixels (default: of a file in the folder)",
    )
    add(
        "--units-per-metre",
        type=positive,
        metavar="N",
        help="of pixels of depth (default: 5000 for TUM RGB-D, 1000 for others)",
    )
    add("--stride", type=count, metavar="N", help="take every Nth row and column of depth images")


def _intrinsics(text: str) -> Intrinsics:
    try:
        fx, fy, cx, cy = map(float, text.split(","))
        return Intrinsics(fx, fy, cx, cy)
    except ValueError as error:
        raise ToolError(
            f"--intrinsics {text}: use FX,FY,CX,CY in pixels, such as 525,525,319.5,239.5 ({error})"
        ) from error


def options_of(options: argparse.Namespace) -> RecordingOptions:
    """Return how the arguments want a recording to be read.

    Raises:
        ToolError: one of them cannot be used.
    """
    ros = RosOptions(
        topics=tuple(options.topics),
        poses=options.poses,
        map_frame=options.map_frame and frame_name(options.map_frame),
        body_frame=options.body_frame and frame_name(options.body_frame),
        depth_stride=options.stride or 1,
        recorder_clock=options.recorder_clock,
        transforms=tuple(map(parse_transform, options.transform)),
    )
    clouds = CloudOptions(options.trajectory, options.points_in, deskew=not options.no_deskew)
    depth = DepthOptions(
        options.trajectory,
        intrinsics=None if options.intrinsics is None else _intrinsics(options.intrinsics),
        units_per_metre=options.units_per_metre,
        stride=options.stride or 1,
    )
    return RecordingOptions(ros, clouds, depth)


def flags_of(options: argparse.Namespace) -> list[str]:
    """Return the flags among the arguments that say how a recording is read."""
    flags: list[str] = []
    for name in _VALUES:
        if (value := getattr(options, name)) is not None:
            flags += [_flag(name), str(value)]
    for transform in options.transform:
        flags += ["--transform", transform]
    flags += [_flag(name) for name in ("recorder_clock", "no_deskew") if getattr(options, name)]
    return [*flags, "--topics", *options.topics] if options.topics else flags


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"
