"""How a planner wants unknown space to count."""

from enum import Enum

from triquad_format.records.arrays import Bools

from triquad_map.errors import UnknownSpaceError


class Unknown(str, Enum):
    """What unknown space counts as."""

    OBSTACLE = "obstacle"
    FREE = "free"
    ERROR = "error"  # to meet it raises UnknownSpaceError


def refuse_unknown(what: str, meets: Bools) -> None:
    """Raise :class:`UnknownSpaceError` where any of N things meets unknown space."""
    if meets.any():
        raise UnknownSpaceError(what, int(meets.argmax()), int(meets.sum()))
