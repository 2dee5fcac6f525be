"""What the page tells of requests: how many, how quickly they are answered, and who is there."""

from collections import Counter

from triquad_format.wire.metrics_messages import ServerMetrics

from triquad_tools.top.amounts import count, milliseconds, rate, size
from triquad_tools.top.interval import Interval, OperationRates, Traffic
from triquad_tools.top.problems import Grade
from triquad_tools.top.section import NONE_YET, Row, Section, counted_each


def asked(seen: Interval) -> tuple[Section, ...]:
    """The parts about requests."""
    metrics, traffic = seen.sample.metrics, seen.traffic
    if metrics is None:
        per_s = seen.rates.requests_refused if seen.rates else None
        rows = counted_each("", seen.sample.status.requests_refused, per_s, Grade.WARNING)
        return (_refused(rows),)
    refused = tuple(row for name in metrics.operations for row in _refusals(name, metrics, traffic))
    return (
        _requests(metrics, traffic),
        _operations(metrics, traffic),
        _refused(refused),
        _clients(metrics),
    )


def _requests(metrics: ServerMetrics, traffic: Traffic | None) -> Section:
    operations = metrics.operations.values()
    totals = {
        "answered": count(sum(operation.answered for operation in operations)),
        "bytes received": size(sum(operation.received_bytes for operation in operations)),
        "bytes sent": size(sum(operation.sent_bytes for operation in operations)),
    }
    rates = dict.fromkeys(totals, NONE_YET)
    if traffic is not None:
        rates = {
            "answered": rate(traffic.requests_answered),
            "bytes received": size(traffic.received_bytes),
            "bytes sent": size(traffic.sent_bytes),
        }
    rows = [Row(name, (rates[name], total)) for name, total in totals.items()]
    pending = sum(operation.pending for operation in operations)
    return Section("REQUESTS", ("/s", "total"), (*rows, Row("pending", ("", count(pending)))))


def _operations(metrics: ServerMetrics, traffic: Traffic | None) -> Section:
    """Operations that were ever asked for, those asked for most first."""
    rates = traffic.operations if traffic else {}
    used = [name for name, one in metrics.operations.items() if one.answered or one.refused]
    by_use = sorted(used, key=lambda name: (-metrics.operations[name].answered, name))
    longest_s = float(metrics.bounds_s[-1])  # that the server tells apart
    rows = tuple(_operation(name, rates.get(name), longest_s) for name in by_use)
    return Section("OPERATIONS", ("/s", "p50 ms", "p99 ms"), rows)


def _operation(name: str, rates: OperationRates | None, longest_s: float) -> Row:
    name = _short(name)
    if rates is None:
        return Row(name, (NONE_YET,) * 3)
    grade = Grade.WARNING if any(rates.refused.values()) else Grade.GOOD
    times = (_time(rates.p50_s, longest_s), _time(rates.p99_s, longest_s))
    return Row(name, (rate(rates.answered), *times), grade)


def _short(operation: str) -> str:
    """Without the branch of keys that it is on, such as ``query/``."""
    return operation.rpartition("/")[2]


def _time(seconds: float | None, longest_s: float) -> str:
    if seconds is None:
        return NONE_YET
    return milliseconds(seconds) if seconds <= longest_s else f">{milliseconds(longest_s)}"


def _refusals(operation: str, metrics: ServerMetrics, traffic: Traffic | None) -> tuple[Row, ...]:
    per_s = traffic.operations[operation].refused if traffic else None
    totals = metrics.operations[operation].refused
    return counted_each(f"{_short(operation)}, ", totals, per_s, Grade.WARNING)


def _refused(rows: tuple[Row, ...]) -> Section:
    return Section("REFUSED", ("/s", "total"), rows)


def _clients(metrics: ServerMetrics) -> Section:
    kinds = sorted(Counter(metrics.sessions.values()).items())
    return Section("CONNECTED", ("",), tuple(Row(kind, (count(n),)) for kind, n in kinds))
