"""The Zenoh session that reaches the nodes of ROS."""

import json
from pathlib import Path

import zenoh
from triquad_format.wire.codec import MAX_MESSAGE_BYTES
from triquad_format.wire.endpoints import DEFAULT_ENDPOINT, full_endpoint
from triquad_format.wire.zenoh_config import QUIET, fill, put

from triquad_tools.console.command import ToolError

_SETTINGS = {
    "mode": "client",
    "connect/timeout_ms": 5000,  # a router that was started together with the bridge needs a moment
    "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
}


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
            f"the router of the ROS nodes, {where}, cannot be reached: "
            f"{str(error).partition(' at /')[0]}: start rmw_zenohd or the robot's "
            "zenoh-bridge-ros2dds, name it with --router, or use --serve"
        ) from error
