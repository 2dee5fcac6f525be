"""What taking part in ROS 2 needs of access control."""

from triquad_format.wire.access_control import Rule, take_part_in_ros2

from triquad_server.ros2.intake.feeds import full_name, prefix_of
from triquad_server.ros2.topics import bridge_key
from triquad_server.ros2_settings import Ros2Settings


def ros2_rules(map_name: str, settings: Ros2Settings) -> tuple[Rule, ...]:
    """What nodes and bridges may do with a server that has these settings."""
    prefix = prefix_of(settings)
    topics = [name for name in (settings.mesh_topic, settings.grid_topic) if name]
    published = [bridge_key(full_name(prefix, name)) for name in topics]
    return take_part_in_ros2(map_name, settings.domain, published)
