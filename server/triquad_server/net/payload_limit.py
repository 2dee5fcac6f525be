"""How large messages may be."""

_POINT_BYTES = 12
_OTHER_BYTES = 4096  # the largest message takes less without its points


def payload_limit(points: int) -> int:
    """Most bytes that a message of so many points may have: what is larger is not decoded."""
    return points * _POINT_BYTES + _OTHER_BYTES
