"""``triquad-ros2``: maps what a robot with ROS 2 publishes, and publishes the map to it."""

import argparse
import os
import re
import sys
from collections.abc import Callable
from functools import partial

from triquad_tools.console.arguments import (
    Place,
    add_server,
    command_parser,
    count,
    place,
    whole,
    within,
)
from triquad_tools.console.command import run_work
from triquad_tools.sensors.ros.type_store import ALL_TF, frame_name

_TOPIC = re.compile(r"(/?[A-Za-z_][A-Za-z0-9_]*)+")


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line; ``@FILE`` stands for what a file has, line by line."""
    made = command_parser(
        "triquad-ros2",
        description="Map the clouds and depth images of a robot with ROS 2 (rmw_zenoh or "
        "zenoh-bridge-ros2dds), and publish the map's mesh and an occupancy grid to it: "
        "docs/guides/ros2.md. @FILE stands for the arguments in a file, one a line.",
        epilog="Exit status: 0 stopped by Ctrl-C or SIGTERM, 1 there is no such server, 2 wrong "
        "usage; with --serve, that of triquad-server where it is not 0.",
    )
    made.fromfile_prefix_chars = "@"
    add = made.add_argument
    serve = "run a map server, too, which is the router of the nodes; what follows are arguments "
    serve += "of triquad-server, such as --store maps --preset indoor"
    add("--serve", nargs=argparse.REMAINDER, metavar="...", help=serve)
    router = "of the nodes (default: that of --config or --serve, or tcp/127.0.0.1:7447)"
    add("--router", metavar="ENDPOINT", help=router)
    add_server(made)
    _add_topics(made.add_argument_group("what is taken in").add_argument)
    outputs = made.add_argument_group("what is published, while somebody subscribes")
    _add_outputs(outputs.add_argument)
    return made


def _add_topics(add: Callable[..., argparse.Action]) -> None:
    own = os.environ.get("ROS_DOMAIN_ID") or "0"
    domain = "of nodes of rmw_zenoh (default: ROS_DOMAIN_ID of the environment, or 0)"
    add("--domain", type=partial(whole, 0, 232), default=own, metavar="ID", help=domain)
    add("--namespace", type=_topic, metavar="NAME", help="before all topics")
    for name, what in (
        ("clouds", "PointCloud2 (default: all, or none with --depth)"),
        ("depth", "depth images; camera_info next to each gives the camera"),
    ):
        add(f"--{name}", type=_topic, nargs="+", default=[], metavar="TOPIC", help=what)
    add("--depth-stride", type=count, default=2, metavar="N", help="every Nth pixel (default: 2)")
    begin = "where the rays of clouds begin, metres, in their frame (default: 0,0,0, and checked)"
    origin = "TOPIC=X,Y,Z"
    add("--ray-origin", type=_origin, nargs="+", default=[], metavar=origin, help=begin)
    poses = "of odometry, poses, transforms or a path (default: /tf)"
    add("--poses", type=_topic, default=ALL_TF, metavar="TOPIC", help=poses)
    add("--body-frame", type=frame_name, default="base_link", metavar="NAME", help="of these poses")
    alone = "clouds of a lidar that tell where the body is, where nothing publishes its pose"
    add("--odometry", type=_topic, metavar="TOPIC", help=alone)
    alike = "have --odometry take no place for one that it came back to"
    add("--no-loops", dest="close_loops", action="store_false", help=alike)
    path = "a path of keyframes as a SLAM has them by now: where it changes, scans are moved; tf: "
    path += "where the frame odom jumps"
    add("--corrections", type=_topic, metavar="TOPIC", help=path)
    to_map_in = "(default: map, odom or world, the first that there is)"
    add("--map-frame", type=frame_name, default="", metavar="NAME", help=to_map_in)
    clock = "which tells the time of messages (default: header)"
    add("--clock", choices=("header", "arrival"), default="header", help=clock)
    waits = "for which a cloud waits for its transforms (default: 2)"
    add("--wait-s", type=partial(within, 0, 60), default=2.0, metavar="S", help=waits)


def _add_outputs(add: Callable[..., argparse.Action]) -> None:
    add("--mesh-level", type=int, choices=(0, 1, 2), default=1, help="of detail (default: 1)")
    rate, most = partial(whole, 1000, 2**40), "of markers, at most (default: 5000000)"
    add("--mesh-bytes-per-s", type=rate, default=5_000_000, metavar="N", help=most)
    for name, low, high, default in (
        ("height", -1e5, 1e5, 0.5),
        ("side", 0.1, 10_000, 40.0),
        ("cell", 0.01, 10, 0.1),
    ):
        metres, what = partial(within, low, high), f"{name} of the occupancy grid"
        help_text = f"{what} (default: {default:g})"
        add(f"--grid-{name}-m", type=metres, default=default, metavar="M", help=help_text)


def _topic(text: str) -> str:
    if len(text) > 255 or not _TOPIC.fullmatch(text):
        raise argparse.ArgumentTypeError(f"{text!r:.300} is not the name of a topic")
    return text


def _origin(text: str) -> tuple[str, Place]:
    topic, _, origin = text.rpartition("=")
    return _topic(topic), place(origin)


main = partial(run_work, "ros2", parser)

if __name__ == "__main__":
    sys.exit(main())
