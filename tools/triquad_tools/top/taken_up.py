"""What the page tells of what the server takes up: memory, and the mapper's time."""

from triquad_tools.top.amounts import size
from triquad_tools.top.interval import Interval
from triquad_tools.top.problems import Grade
from triquad_tools.top.section import Row, Section

_NEARLY_FULL = 0.9  # of what the map may take: scans are refused soon


def taken_up(seen: Interval) -> tuple[Section, ...]:
    """The parts about memory and time."""
    shares = seen.traffic.mapper_share if seen.traffic else {}
    times = tuple(Row(activity, (f"{100.0 * share:.0f} %",)) for activity, share in shares.items())
    return (_memory(seen), Section("MAPPER'S TIME", ("",), times))


def _memory(seen: Interval) -> Section:
    """Of the whole process, and of its parts that take any, the largest first."""
    metrics, status = seen.sample.metrics, seen.sample.status
    parts = metrics.memory_bytes.items() if metrics else ()
    largest_first = sorted(parts, key=lambda part: (-part[1], part[0]))
    rows = [Row("whole process", (size(status.memory_bytes),))]
    if status.map_max_bytes:
        full = status.map_bytes >= _NEARLY_FULL * status.map_max_bytes
        used = f"{size(status.map_bytes)} of {size(status.map_max_bytes)}"
        rows.append(Row("map", (used,), Grade.WARNING if full else Grade.GOOD))
    rows += [Row(name, (size(number),)) for name, number in largest_first if number]
    return Section("MEMORY", ("",), tuple(rows))
