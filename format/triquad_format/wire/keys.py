"""Zenoh key expressions: one key per operation, so that access control can distinguish them.

A map or source whose name cannot stand in a key is refused with a :class:`FormatError`.
"""

import re

from triquad_format.errors import FormatError
from triquad_format.wire.codec import PROTOCOL_VERSION, Message

NAME = r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}"
"""The form of the name of a map or a source."""

DEFAULT_MAP = "default"
"""The name of the map where none is given."""

EVERY_MAP = "*"
"""The wildcard for a map's name in key expressions of all maps."""

SCHEMA_PREFIX = "application/msgpack;triquad."

# Operations on `triquad/<map>/query/...`: they read the map.
SDF = "query/sdf"
DISTANCE = "query/distance"
SPHERES = "query/spheres"
SEGMENTS = "query/segments"
RAYS = "query/rays"
GROUND = "query/ground"
GRID = "query/grid"
ALIGN = "query/align"
CHANGES = "query/changes"
SOURCES = "query/sources"
TILE_LIST = "query/tiles"
MESH = "query/mesh"
TILE_CHANGES = "query/tile_changes"
STATUS = "query/status"
METRICS = "query/metrics"
FLUSH = "query/flush"
MAP_INFO = "query/map"
MAP_CHUNK = "query/map_chunk"
# Operations on `triquad/<map>/admin/...`: they change the map or the disk.
CHECKPOINT = "admin/checkpoint"
RESET = "admin/reset"
CORRECT_POSES = "admin/correct_poses"
CREATE_MAP = "admin/create_map"
DROP_MAP = "admin/drop_map"


def is_name(name: str) -> bool:
    """Return whether a map or source can have this name."""
    return re.fullmatch(NAME, name) is not None


def check_name(kind: str, name: str) -> str:
    """Return ``name``, where it can stand in a key."""
    if not isinstance(name, str) or not is_name(name):
        raise FormatError(
            f"{kind} name {name!r} is not allowed: use a text of 1 to 64 letters, digits, "
            "'_', '.', '-', beginning with a letter or digit"
        )
    return name


def operation_key(map_name: str, operation: str) -> str:
    """Return the key of a query, such as ``triquad/default/query/sdf``."""
    return f"triquad/{check_name('map', map_name)}/{operation}"


def all_queries_key(map_name: str) -> str:
    """Return the key expression of all operations that read a map."""
    return f"triquad/{_map_chunk(map_name)}/query/*"


def all_admin_key(map_name: str) -> str:
    """Return the key expression of all operations that change a map or the disk."""
    return f"triquad/{_map_chunk(map_name)}/admin/*"


def scan_key(map_name: str, source: str) -> str:
    """Return the key on which a source publishes its scans."""
    return f"triquad/{_map_chunk(map_name)}/scan/{check_name('source', source)}"


def all_scans_key(map_name: str) -> str:
    """Return the key expression of the scans of all sources."""
    return f"triquad/{_map_chunk(map_name)}/scan/*"


def status_key(map_name: str) -> str:
    """Return the key on which the server publishes its status about once a second."""
    return f"triquad/{_map_chunk(map_name)}/status"


def alive_key(map_name: str, server: str) -> str:
    """Return the liveliness token of a server; ``*`` for both lists all servers and their maps."""
    return f"triquad/{map_name}/@alive/{server}"


def encoding(message: type[Message]) -> str:
    """Return a message's Zenoh encoding, such as ``application/msgpack;triquad.SdfRequest.v1``."""
    return f"{SCHEMA_PREFIX}{message.__name__}.v{PROTOCOL_VERSION}"


def _map_chunk(map_name: str) -> str:
    return map_name if map_name == EVERY_MAP else check_name("map", map_name)
