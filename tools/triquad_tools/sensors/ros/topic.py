"""Names of topics."""

import re

_MAX_CHARACTERS = 64


def source_of_topic(topic: str) -> str:
    """Return the source name of a topic's scans: ``/lidar/points`` is ``lidar.points``.

    What cannot stand in such a name becomes an underscore.
    """
    name = re.sub(r"[^A-Za-z0-9_.-]", "_", topic.strip("/").replace("/", "."))
    return re.sub(r"^[^A-Za-z0-9]+", "", name)[:_MAX_CHARACTERS] or "default"
