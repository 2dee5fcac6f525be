"""``triquad-ros2``: maps what a robot with ROS 2 publishes, and publishes the map to it."""

import argparse
import logging
import os
import re
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import fields
from functools import partial

from triquad_client import Client, ConnectError, UnknownMapError
from triquad_format.printable import printable

from triquad_tools.console.arguments import (
    add_server,
    command_parser,
    connect_to,
    count,
    whole,
    within,
)
from triquad_tools.console.command import FAILED, OK, ToolError, run
from triquad_tools.ros2.bridge import bridging, open_session
from triquad_tools.ros2.options import (
    MAX_GRID_CELLS,
    TF_POSES,
    BridgeOptions,
    SliceShape,
    TopicChoice,
    full_name,
)
from triquad_tools.ros2.server_process import ServerProcess
from triquad_tools.sensors.ros.type_store import frame_name

_COMMAND = "triquad-ros2"
_TOPIC = re.compile(r"(/?[A-Za-z_][A-Za-z0-9_]*)+")

_ATTEMPT_S = 2.0  # after which it is checked whether our server still runs

_log = logging.getLogger("triquad_ros2")


def _start_log() -> None:
    handler = logging.StreamHandler()
    handler.setFormatter(_Lines("%(asctime)s %(levelname)s ros2: %(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[handler])


class _Lines(logging.Formatter):
    """Lines in which names from the network cannot look like other lines."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802
        """Return the line of a message."""
        record.message = printable(record.message)
        return super().formatMessage(record)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool: 0 stopped, 1 the server failed, 2 wrong usage; with --serve, as the server."""
    _start_log()
    return run(_COMMAND, partial(_run, parser().parse_args(argv)))


def _run(options: argparse.Namespace) -> int:
    asked = bridge_options(options)
    server: ServerProcess | None = None
    by_signal = FAILED
    try:
        with ExitStack() as stack:
            if options.serve is not None:
                server = stack.enter_context(ServerProcess(options.serve, asked.topics))
                options.map = options.map or server.map_name
                if options.config is None:
                    options.connect = options.connect or server.endpoint
                    options.router = options.router or server.endpoint
            _bridge(options, asked, server)
    except KeyboardInterrupt:
        _log.info("stopped")
        by_signal = OK  # a server that was just starting ends so, too
    code = OK if server is None else server.exit_code or OK
    return by_signal if code < OK else code


def _bridge(
    options: argparse.Namespace, asked: BridgeOptions, server: ServerProcess | None
) -> None:
    """Bridge until the server ends, or else for ever."""
    client = _connected(options, server)
    if client is None:
        return
    with (
        client,
        closing(open_session(options.router, options.config)) as session,
        bridging(session, client, asked) as intake,
    ):
        try:
            if server is None:
                threading.Event().wait()
            else:
                server.wait()
        finally:
            dropped = ", ".join(f"{reason}: {n}" for reason, n in intake.dropped.items())
            _log.info("%d scans published, dropped: %s", intake.published, dropped or "none")


def _connected(options: argparse.Namespace, server: ServerProcess | None) -> Client | None:
    """Return a client of the map server, once it serves; None where one of ours ended before."""
    while server is None or server.exit_code is None:
        try:
            if server is not None:  # it may also end before it is there
                connect_to(options, timeout_s=_ATTEMPT_S).close()
            return connect_to(options)
        except (ConnectError, UnknownMapError):
            if server is None:
                raise
    return None


def bridge_options(options: argparse.Namespace) -> BridgeOptions:
    """Return what the arguments ask of the bridge.

    Raises:
        ToolError: the grid would have too many cells.
    """
    grid = SliceShape(options.grid_height_m, options.grid_side_m, options.grid_cell_m)
    if grid.cells**2 > MAX_GRID_CELLS:
        raise ToolError(
            f"a grid of {grid.side_m:g} m has {grid.cells} cells of {grid.cell_m:g} m along each "
            f"side: use at most {int(MAX_GRID_CELLS**0.5)}"
        )
    prefix = full_name("", options.namespace or "").rstrip("/")
    topics = TopicChoice(
        options.domain,
        prefix,
        clouds=tuple(full_name(prefix, name) for name in options.clouds),
        depth=tuple(full_name(prefix, name) for name in options.depth),
        poses=None if options.poses.strip("/") == TF_POSES else full_name(prefix, options.poses),
    )
    others = {field.name for field in fields(BridgeOptions)} - {"topics", "grid"}
    return BridgeOptions(topics, grid, **{name: getattr(options, name) for name in others})


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line; ``@FILE`` stands for what a file has, line by line."""
    made = command_parser(
        _COMMAND,
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
    poses = "of odometry, poses, transforms or a path (default: /tf)"
    add("--poses", type=_topic, default=TF_POSES, metavar="TOPIC", help=poses)
    add("--body-frame", type=frame_name, default="base_link", metavar="NAME", help="of these poses")
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


if __name__ == "__main__":
    sys.exit(main())
