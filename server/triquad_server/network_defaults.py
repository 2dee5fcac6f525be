"""The network defaults, without a configuration: no more than the protocol needs."""

from triquad_format.wire.access_control import without_credentials
from triquad_format.wire.limits import MAX_QUERY_POINTS, payload_limit

from triquad_server.net.configuration import NetworkDefaults
from triquad_server.settings import Settings

_SENSOR_POINT_BYTES = 64
"""The bytes of a point with all fields of lidar drivers, in messages for which a server is only the
router."""


def network_defaults(map_name: str, settings: Settings) -> NetworkDefaults:
    """Return the defaults of the server of a map."""
    return NetworkDefaults(without_credentials(map_name), _max_message_bytes(settings))


def _max_message_bytes(settings: Settings) -> int:
    """Return the largest message that is received at all.

    It is twice the largest that is answered: what is somewhat too large is refused with the reason,
    and only what is far beyond gets no answer.
    """
    largest = 2 * payload_limit(max(MAX_QUERY_POINTS, settings.scan.max_points))
    return max(largest, payload_limit(0) + settings.scan.max_points * _SENSOR_POINT_BYTES)
