"""What the page tells of what comes in: scans, their sources, and points that are not used."""

from triquad_format.wire.metrics_messages import SourceMetrics

from triquad_tools.top.amounts import count, duration, rate, size
from triquad_tools.top.interval import Interval, SourceRates
from triquad_tools.top.problems import Grade
from triquad_tools.top.section import NONE_YET, Row, Section, counted, counted_each

_SILENT_S = 5.0  # of a source, while others are heard


def incoming(seen: Interval) -> tuple[Section, ...]:
    """The parts about scans."""
    return (_scans(seen), *_sources(seen), _points(seen))


def _scans(seen: Interval) -> Section:
    status, rates = seen.sample.status, seen.rates
    rows = [
        counted("taken", status.scans_taken, rates.scans_taken if rates else None),
        Row("waiting", ("", count(status.scans_waiting))),
    ]
    if seen.sample.metrics is not None:
        received = seen.sample.metrics.scan_bytes_received
        per_s = size(seen.traffic.scan_bytes_received) if seen.traffic else NONE_YET
        rows.append(Row("bytes received", (per_s, size(received))))
    else:
        lost = rates.scans_lost if rates else None
        rows += counted_each("lost, ", status.scans_lost, lost, Grade.ERROR)
    dropped = rates.scans_dropped if rates else None
    rows += counted_each("dropped, ", status.scans_dropped, dropped, Grade.ERROR)
    return Section("SCANS", ("/s", "total"), tuple(rows))


def _sources(seen: Interval) -> tuple[Section, ...]:
    metrics = seen.sample.metrics
    if metrics is None:
        return ()
    rates = seen.traffic.sources if seen.traffic else {}
    heard = any(source.age_s < _SILENT_S for source in metrics.sources.values())
    rows = tuple(
        _source(name, source, rates.get(name), heard)
        for name, source in sorted(metrics.sources.items())
    )
    return (Section("SOURCES", ("/s", "lost", "heard"), rows),)


def _source(name: str, source: SourceMetrics, rates: SourceRates | None, others: bool) -> Row:
    grade = Grade.GOOD
    if rates is not None and rates.lost + rates.refused > 0.0:
        grade = Grade.ERROR
    elif others and source.age_s >= _SILENT_S:
        grade = Grade.WARNING
    taken = NONE_YET if rates is None else rate(rates.taken)
    return Row(name, (taken, count(source.lost), f"{duration(source.age_s)} ago"), grade)


def _points(seen: Interval) -> Section:
    per_s = seen.rates.points_dropped if seen.rates else None
    rows = counted_each("", seen.sample.status.points_dropped, per_s)
    return Section("POINTS DROPPED", ("/s", "total"), rows)
