"""The bridge between ROS 2 and a map server, and the session that reaches the nodes of ROS."""

import json
import logging
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path

import zenoh
from triquad_client import Client
from triquad_format.errors import TriquadError
from triquad_format.wire.codec import MAX_MESSAGE_BYTES
from triquad_format.wire.endpoints import DEFAULT_ENDPOINT, full_endpoint
from triquad_format.wire.zenoh_config import QUIET, fill, put, reason

from triquad_tools.console.command import ToolError
from triquad_tools.ros2.intake.intake import Intake
from triquad_tools.ros2.node import Node
from triquad_tools.ros2.options import BridgeOptions
from triquad_tools.ros2.output.grid_publisher import GridPublisher
from triquad_tools.ros2.output.mesh_publisher import MeshPublisher
from triquad_tools.ros2.output.topic_publisher import TopicPublisher
from triquad_tools.ros2.topics import Delivery, Topic
from triquad_tools.sensors.ros.type_store import MARKER, OCCUPANCY_GRID

_log = logging.getLogger("triquad_ros2")

_PERIOD_S, _RETRY_S = 0.5, 5.0  # between two rounds; after an error
_MESH_DELIVERY = Delivery(depth=100)
_GRID_DELIVERY = Delivery(latched=True, depth=1)  # as Nav2 expects of a map

_SETTINGS = {
    "mode": "client",
    "connect/timeout_ms": 5000,  # a router that was started together with the bridge needs a moment
    "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
}


@contextmanager
def bridging(session: zenoh.Session, client: Client, options: BridgeOptions) -> Iterator[Intake]:
    """Take part in ROS 2 for a map server while the context is open; yield what takes scans in."""
    topics = options.topics
    below = f" below {topics.prefix}" if topics.prefix else ""
    _log.info("listening in domain %d%s", topics.domain, below)
    with ExitStack() as parts:
        node = parts.enter_context(closing(Node(session, topics.domain)))
        intake = parts.enter_context(closing(Intake(session, client, options, node)))
        topic = partial(TopicPublisher, session, node, domain=topics.domain)
        markers = topic(Topic(topics.mesh, MARKER), delivery=_MESH_DELIVERY)
        parts.enter_context(closing(markers))
        slices = topic(Topic(topics.grid, OCCUPANCY_GRID), delivery=_GRID_DELIVERY)
        parts.enter_context(closing(slices))
        mesh = MeshPublisher(markers, client, options.mesh_level, options.mesh_bytes_per_s)
        parts.enter_context(closing(mesh))
        grid = GridPublisher(slices, client, options.grid)
        parts.enter_context(_published(mesh, intake))
        parts.enter_context(_published(grid, intake))
        yield intake


@contextmanager
def _published(output: MeshPublisher | GridPublisher, intake: Intake) -> Iterator[None]:
    """Publish an output again and again while the context is open; it holds up no other."""
    stopping = threading.Event()

    def run() -> None:
        pause_s = _PERIOD_S
        while not stopping.wait(pause_s):
            place, pause_s = intake.place, _PERIOD_S
            try:
                if place is not None:
                    output.publish(place, _PERIOD_S)
            except TriquadError as error:
                _log.warning("the map cannot be published now: %s", error)
                pause_s = _RETRY_S
            except Exception:
                _log.exception("the map could not be published")
                pause_s = _RETRY_S

    thread = threading.Thread(target=run, name="ros2-map")
    thread.start()
    try:
        yield
    finally:
        stopping.set()
        thread.join()


def open_session(router: str | None, file: Path | None) -> zenoh.Session:
    """Return a client of the router that the nodes use; the caller closes it.

    Args:
        router: its endpoint; ``None``: that of the file, or else port 7447 of this machine.
        file: a Zenoh configuration, such as one with credentials.

    Raises:
        ToolError: the router cannot be reached, or the file is no configuration.
    """
    try:
        config = zenoh.Config() if file is None else zenoh.Config.from_file(str(file))
        fill(config, {**QUIET, **_SETTINGS}, unset=zenoh.Config())
        if router is not None or not json.loads(config.get_json("connect/endpoints")):
            put(config, {"connect/endpoints": [full_endpoint(router or DEFAULT_ENDPOINT)]})
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = router or file or DEFAULT_ENDPOINT
        raise ToolError(
            f"the router of the ROS nodes, {where}, cannot be reached: {reason(error)}: start "
            "rmw_zenohd or the robot's zenoh-bridge-ros2dds, name it with --router, or use --serve"
        ) from error
