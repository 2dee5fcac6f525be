"""Zenoh configurations: what client and server set alike, and what a file of the user set before.

Values go by their paths, such as ``scouting/multicast/enabled``.
"""

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import zenoh

QUIET: Mapping[str, Any] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    # Samples in shared memory are lost without notice where the receiver is descheduled for a
    # tenth of a second, which training does to it.
    "transport/shared_memory/enabled": False,
}
"""Settings to search for no others nor to be found by them, and without shared memory."""

_MADE_UP_OF_ONE = ("access_control", "transport/shared_memory")
"""Sections of which a part makes no sense without the others: a file sets all or nothing."""


def reason(error: Exception) -> str:
    """Return what Zenoh says of an error, on one line, without where in Zenoh it happened."""
    return " ".join(str(error).split(" at /", 1)[0].split())


def put(config: "zenoh.Config", values: Mapping[str, Any]) -> None:
    """Set values, by path."""
    for path, value in values.items():
        config.insert_json5(path, json.dumps(value))


def fill(config: "zenoh.Config", values: Mapping[str, Any], unset: "zenoh.Config") -> None:
    """Set the values that are not set yet: that are as in ``unset``, a new configuration."""
    put(config, {path: value for path, value in values.items() if not is_set(config, path, unset)})


def is_set(config: "zenoh.Config", path: str, unset: "zenoh.Config") -> bool:
    """Return whether a value differs from that of ``unset``, a new configuration."""
    for section in _MADE_UP_OF_ONE:
        if path.startswith(section):
            path = section
    return bool(config.get_json(path) != unset.get_json(path))
