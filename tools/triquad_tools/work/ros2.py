"""``triquad-ros2``: maps what a robot with ROS 2 publishes, and publishes the map to it."""

import argparse
import logging
import threading
from contextlib import ExitStack, closing
from dataclasses import fields

from triquad_client import Client, ConnectError, UnknownMapError
from triquad_format.printable import printable

from triquad_tools.console.arguments import connect_to
from triquad_tools.console.command import FAILED, OK, ToolError
from triquad_tools.ros2.bridge import bridging, open_session
from triquad_tools.ros2.options import (
    MAX_GRID_CELLS,
    BridgeOptions,
    SliceShape,
    TopicChoice,
    full_name,
)
from triquad_tools.ros2.server_process import ServerProcess
from triquad_tools.sensors.ros.type_store import ALL_TF

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


def work(options: argparse.Namespace) -> int:
    """Bridge until the server ends, or Ctrl-C."""
    _start_log()
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


def _poses_topic(prefix: str, topic: str) -> str:
    """Return the full name of a topic with poses, or what stands for all transforms."""
    return ALL_TF if topic.strip("/") == ALL_TF else full_name(prefix, topic)


def bridge_options(options: argparse.Namespace) -> BridgeOptions:
    """Return what the arguments ask of the bridge.

    Raises:
        ToolError: the grid would have too many cells, or corrections find no scan.
    """
    grid = SliceShape(options.grid_height_m, options.grid_side_m, options.grid_cell_m)
    if grid.cells**2 > MAX_GRID_CELLS:
        raise ToolError(
            f"a grid of {grid.side_m:g} m has {grid.cells} cells of {grid.cell_m:g} m along each "
            f"side: use at most {int(MAX_GRID_CELLS**0.5)}"
        )
    if options.corrections and options.clock == "arrival":
        raise ToolError(
            "--corrections finds scans by the stamps of their headers, so --clock arrival cannot "
            "be used with it"
        )
    prefix = full_name("", options.namespace or "").rstrip("/")
    poses = _poses_topic(prefix, options.poses)
    corrections = options.corrections and _poses_topic(prefix, options.corrections)
    if corrections == ALL_TF != poses:
        raise ToolError("--corrections tf follows transforms, so --poses cannot be used with it")
    odometry = options.odometry and full_name(prefix, options.odometry)
    if odometry and (poses != ALL_TF or corrections):
        raise ToolError("--odometry finds the poses: leave out --poses and --corrections")
    clouds = tuple(full_name(prefix, name) for name in options.clouds)
    if not (odometry or options.close_loops):
        raise ToolError("--no-loops says how --odometry finds the poses: give that, too")
    if odometry and clouds and odometry not in clouds:
        raise ToolError(f"--odometry {odometry} is of clouds that are taken: name it in --clouds")
    if odometry and not clouds:
        clouds = (odometry,)
    topics = TopicChoice(
        options.domain,
        prefix,
        clouds=clouds,
        depth=tuple(full_name(prefix, name) for name in options.depth),
        odometry=odometry,
        corrections=corrections,
        poses=None if poses == ALL_TF else poses,
    )
    origins = {full_name(prefix, name): place for name, place in options.ray_origin}
    others = {field.name for field in fields(BridgeOptions)} - {"topics", "grid", "ray_origins"}
    values = {name: getattr(options, name) for name in others}
    return BridgeOptions(topics, grid, ray_origins=origins, **values)
