"""The status of a queried point, by the evidence."""

from enum import IntEnum


class Status(IntEnum):
    """Status of a point; the values travel on the wire as ``uint8``."""

    UNKNOWN = 0
    """No ray has shown anything here: the distance is not to be trusted."""

    FREE = 1
    """Rays have passed through here."""

    SURFACE = 2
    """Within half a voxel of one in which a ray ended: there the distance is trained."""
