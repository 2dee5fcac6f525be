"""How a planner wants unknown space to count."""

from enum import Enum

from triquad_format.errors import TriquadError
from triquad_format.records.arrays import Bools


class UnknownSpaceError(TriquadError):
    """What was asked about meets unknown space, which was to count as an error."""

    def __init__(self, what: str, index: int, count: int) -> None:
        others = f", and {count - 1} others do" if count > 1 else ""
        super().__init__(
            f"{what} {index} meets unknown space{others}: look there first, or let unknown space "
            "count as 'obstacle' or 'free'"
        )
        self.index = index
        self.count = count


class Unknown(str, Enum):
    """What unknown space counts as."""

    OBSTACLE = "obstacle"
    FREE = "free"
    ERROR = "error"  # to meet it raises UnknownSpaceError


def refuse_unknown(what: str, meets: Bools) -> None:
    """Raise :class:`UnknownSpaceError` where any of N things meets unknown space."""
    if meets.any():
        raise UnknownSpaceError(what, int(meets.argmax()), int(meets.sum()))
