"""What the page tells of what the server takes up: memory, and the mapper's time."""

from triquad_tools.top.amounts import size
from triquad_tools.top.interval import Interval
from triquad_tools.top.section import Row, Section


def taken_up(seen: Interval) -> tuple[Section, ...]:
    """The parts about memory and time."""
    shares = seen.traffic.mapper_share if seen.traffic else {}
    times = tuple(Row(activity, (f"{100.0 * share:.0f} %",)) for activity, share in shares.items())
    return (_memory(seen), Section("MAPPER'S TIME", ("",), times))


def _memory(seen: Interval) -> Section:
    """Of the whole process, and of its parts that take any, the largest first."""
    metrics = seen.sample.metrics
    parts = metrics.memory_bytes.items() if metrics else ()
    largest_first = sorted(parts, key=lambda part: (-part[1], part[0]))
    rows = [Row("whole process", (size(seen.sample.status.memory_bytes),))]
    rows += [Row(name, (size(number),)) for name, number in largest_first if number]
    return Section("MEMORY", ("",), tuple(rows))
