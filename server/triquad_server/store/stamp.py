"""The time that goes into files."""

import time


def stamp_now_ns() -> int:
    """Nanoseconds since 1970; within what a file can hold, whatever the clock says."""
    return min(max(time.time_ns(), 0), 2**63 - 1)
