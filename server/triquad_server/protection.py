"""What a server lets in without a configuration that says so: no more than the protocol needs."""

from triquad_format.wire.access_control import Rule, without_credentials

from triquad_server.net.configuration import Protection
from triquad_server.net.requests import payload_limit
from triquad_server.settings import Settings

_ROS_POINT_BYTES = 64
"""Of a point with all that drivers of lidars tell of it."""


def protection(map_name: str, settings: Settings) -> Protection:
    """The protection of the server of a map."""
    rules = _of_ros2(map_name, settings) if settings.ros2.enabled else ()
    return Protection(
        without_credentials(map_name, ros2=rules),
        _max_message_bytes(settings),
        # Nodes of rmw_zenoh find each other by their router.
        gossip=settings.ros2.enabled,
    )


def _max_message_bytes(settings: Settings) -> int:
    """The largest message that is received at all.

    It is twice what is answered: what is somewhat too large is refused with the reason, and only
    what is far beyond goes without an answer.
    """
    largest = 2 * payload_limit(max(settings.service.max_query_points, settings.scan.max_points))
    if not settings.ros2.enabled:
        return largest
    return max(largest, payload_limit(0) + settings.scan.max_points * _ROS_POINT_BYTES)


def _of_ros2(map_name: str, settings: Settings) -> tuple[Rule, ...]:
    # Only where it is wanted, since the types of ROS take a while to import.
    from triquad_server.ros2.access import ros2_rules

    return ros2_rules(map_name, settings.ros2)
