"""How a user says on the command line which recording is meant, and how it is to be read."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from triquad_tools.console.arguments import count, not_negative, place, positive
from triquad_tools.sensors.ros.type_store import frame_name

if TYPE_CHECKING:
    from triquad_client.depth_image import Intrinsics

    from triquad_tools.sensors.motion.track import Transform

WORLD, SENSOR = "world", "sensor"  # the frames in which points may be

_Add = Callable[..., argparse.Action]


def add_recording(parser: argparse.ArgumentParser, *, several: bool = False) -> None:
    """Let a command take a recording, or ``several`` of one frame, and choose from each."""
    kinds = "a bag of ROS 1 or ROS 2, an MCAP file, or a folder of scans (docs/tools.md)"
    kinds += "; several have their poses in the same frame" if several else ""
    number = "+" if several else 1
    parser.add_argument("recordings", type=Path, nargs=number, metavar="RECORDING", help=kinds)
    _add_choice(parser.add_argument_group("which scans").add_argument)
    _add_ros(parser.add_argument_group("bags and MCAP files").add_argument)
    _add_folder(parser.add_argument_group("folders of clouds or depth images").add_argument)


def _add_choice(add: _Add) -> None:
    add("--start", type=not_negative, default=0.0, metavar="S", help="seconds after the first scan")
    add("--end", type=positive, metavar="S", help="seconds after the first scan")
    add("--every", type=count, default=1, metavar="N", help="take every Nth scan of each sensor")
    nearer = "leave out nearer points: the vehicle's own body (default: 0)"
    add("--range-min", type=not_negative, default=0.0, metavar="M", help=nearer)
    poses = "of the sensor (default: a file with a usual name; those of a bag)"
    add("--trajectory", type=Path, metavar="FILE", help=poses)
    add("--odometry", action="store_true", help="find the poses of a lidar by its clouds alone")
    alike = "where places look alike: let --odometry take none for another"
    add("--no-loops", dest="loops", action="store_false", help=alike)
    begin = "where rays begin, metres, in the frame of the clouds (default: 0,0,0, and checked)"
    add("--ray-origin", type=place, metavar="X,Y,Z", help=begin)


def _add_ros(add: _Add) -> None:
    topics = "of clouds or depth images (default: all clouds, or else all depth images)"
    add("--topics", nargs="+", default=[], metavar="TOPIC", help=topics)
    poses = "of odometry or poses, or 'tf' for transforms (default: what places the most scans)"
    add("--poses", metavar="TOPIC", help=poses)
    to_map_in = "to map in (default: map, odom, world or the root)"
    add("--map-frame", type=frame_name, metavar="FRAME", help=to_map_in)
    add("--body-frame", type=frame_name, metavar="FRAME", help="whose poses those of --poses are")
    add(
        "--transform",
        dest="transforms",
        type=transform,
        action="append",
        default=[],
        metavar="'PARENT CHILD X Y Z QX QY QZ QW'",
        help="that the recording lacks, metres and a quaternion, repeatable",
    )
    clock = "go by when messages were recorded, where their stamps are of different clocks"
    add("--recorder-clock", action="store_true", help=clock)


def _add_folder(add: _Add) -> None:
    order = "order of its quaternions (default: as its header or form has it)"
    add("--quaternion", choices=("xyzw", "wxyz"), help=order)
    frame = "frame of the points of clouds (default: sensor, and checked)"
    add("--points-in", choices=(SENSOR, WORLD), help=frame)
    columns = "of .bin clouds, float32 (default: xyzi, and checked)"
    add("--columns", type=_columns, metavar="xyzirt|x,y,z,NAME", help=columns)
    skewed = "clouds are free of motion, though they have times"
    add("--no-deskew", dest="deskew", action="store_false", help=skewed)
    camera = "of the depth camera, pixels (default: of a file in the folder)"
    add("--intrinsics", type=_intrinsics, metavar="FX,FY,CX,CY", help=camera)
    units = "of pixels of depth (default: 5000 for TUM RGB-D, 1000 for others)"
    add("--units-per-metre", type=positive, metavar="N", help=units)
    stride = "take every Nth row and column of depth images"
    add("--stride", type=count, default=1, metavar="N", help=stride)


def transform(text: str) -> "Transform":
    """Return a transform such as ``base_link lidar 0 0 1.5 0 0 0 1``: position and quaternion."""
    from triquad_client.pose import Pose  # slow to import, as below

    from triquad_tools.sensors.motion.track import STATIC, Transform

    try:
        parent, child, *numbers = text.split()
        x, y, z, *quaternion = map(float, numbers)
        pose = Pose((x, y, z), quaternion)
        pose.matrix()
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"{text!r}: put all 9 words in quotes, 'PARENT CHILD X Y Z QX QY QZ QW', such as "
            f"'base_link lidar 0 0 1.5 0 0 0 1' ({error})"
        ) from error
    return Transform(frame_name(parent), frame_name(child), STATIC, pose)


def _columns(text: str) -> tuple[str, ...]:
    letters = {"i": "intensity", "r": "ring"}
    words = text.split(",") if "," in text else text
    names = [letters.get(word.strip(), word.strip()) for word in words]
    if sorted(name for name in names if name in ("x", "y", "z")) != ["x", "y", "z"]:
        raise argparse.ArgumentTypeError(
            f"{text!r}: use x, y and z once each, such as xyzirt or x,y,z,intensity,ring,t; _ is "
            "a column that is not used"
        )
    return tuple(names)


def _intrinsics(text: str) -> "Intrinsics":
    from triquad_client.depth_image import Intrinsics

    try:
        fx, fy, cx, cy = map(float, text.split(","))
        return Intrinsics(fx, fy, cx, cy)
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"{text!r}: use FX,FY,CX,CY in pixels, such as 525,525,319.5,239.5 ({error})"
        ) from error
