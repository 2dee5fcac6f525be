"""How many bytes a message from outside may have before it is looked at."""

_POINT_BYTES = 12
_OTHER_BYTES = 4096  # the largest message takes less without its points


def payload_limit(points: int) -> int:
    """Bytes that a message of at most so many points keeps to."""
    return points * _POINT_BYTES + _OTHER_BYTES
