"""The page: what is out of order, then tables of figures in as many columns as there is room."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from rich.console import Group
from rich.table import Table
from rich.text import Text
from triquad_format.errors import ERROR_CODES
from triquad_format.printable import printable

from triquad_tools.console.amounts import count, duration, milliseconds, rate, size, within
from triquad_tools.top.interval import Rates, Sample

_COLUMN_WIDTH, _GAP = 39, 2  # characters that a table needs, and between columns
_SILENT_S = 5.0  # of a source, while others are active
_OVERDUE_EPOCH_S = 10.0  # while there is something to learn, two a second are published
_NEARLY_FULL = 0.9  # of what the map may take

Rows = list[tuple[str, ...]]


@dataclass(frozen=True)
class Seen:
    """The known state of a server."""

    sample: Sample
    rates: Rates | None  # None: this is the first sample of this server
    restarted: bool = False  # since the sample before
    silent: str | None = None  # why it does not answer any more


def page(title: str, seen: Seen, width: int) -> Group:
    """Draw what is known of a server; ``title`` says which it is, ``width`` is in characters."""
    status = seen.sample.status
    up = f"triquad {status.version} on {status.device}, up {duration(status.uptime_s)}"
    head = [Text(printable(f"{title}, {up}"), "bold")]
    head += [Text(printable(f"!! {problem}"), "bold red") for problem in problems(seen)]
    if seen.rates is None:
        return Group(*head, "rates are told from the second sample on")
    number = max(1, (width + _GAP) // (_COLUMN_WIDTH + _GAP))
    stacks: list[list[Table]] = [[] for _ in range(number)]
    for titles, rows in _tables(seen.sample, seen.rates):
        shortest = min(stacks, key=lambda stack: sum(2 + table.row_count for table in stack))
        shortest += [_table(titles, rows)] if rows else []
    columns = Table.grid(*([""] * number), expand=True, padding=(0, _GAP, 0, 0))
    for column in columns.columns:
        column.ratio = 1
    columns.add_row(*(Group(*stack) for stack in stacks), style="dim" if seen.silent else "")
    return Group(*head, "", columns)


def problems(seen: Seen) -> list[str]:
    """Return what is out of order now, in whole sentences, most serious first."""
    found = [] if seen.silent is None else [seen.silent]
    if seen.restarted:
        found.append("the server was restarted: its counts began again")
    return [*found, *_problems(seen.sample), *(_losses(seen.rates) if seen.rates else ())]


def _problems(sample: Sample) -> Iterator[str]:
    status, metrics, ages_s = sample.status, sample.metrics, sample.each("sources.age_s")
    if metrics.problem is not None:
        yield metrics.problem
    for name, queue in metrics.queues.items():
        if queue.waiting >= queue.limit > 0:
            yield f"the queue of {name} is full: {count(queue.waiting)} wait"
    if metrics.epoch_age_s > _OVERDUE_EPOCH_S and not status.settled:
        yield f"no new epoch for {duration(metrics.epoch_age_s)}, although something is to learn"
    if status.map_bytes >= _NEARLY_FULL * status.map_max_bytes > 0:
        yield f"the map nears {size(status.map_max_bytes)}: beyond, scans are refused"
    for name, age_s in ages_s.items():
        if age_s >= _SILENT_S > min(ages_s.values()):
            yield f"source {name} is silent for {duration(age_s)}"
    yield from (status.warnings or "").splitlines()


def _losses(rates: Rates) -> Iterator[str]:
    for name, per_s in rates.source_lost.items():
        if per_s > 0.0:
            yield f"source {name}: {rate(per_s)} scans a second are lost"
    for reason, per_s in rates.scans_dropped.items():
        if per_s > 0.0:
            yield f"{rate(per_s)} scans a second are refused: {reason}"
    for name, per_s in rates.refused.items():
        code = name.rpartition(" ")[2]
        if per_s > 0.0 and code in ("busy", "internal"):  # for others the client is to blame
            yield f"{name}: {rate(per_s)} requests a second are refused: {ERROR_CODES[code]}"


def _tables(sample: Sample, rates: Rates) -> Iterator[tuple[str, Rows]]:
    """Yield titles and rows of all tables, the most important ones first."""
    status, metrics = sample.status, sample.metrics
    taken = ("taken", rate(rates.scans_taken), count(status.scans_taken))
    received = (size(rates.scan_bytes_received), size(metrics.scan_bytes_received))
    dropped = _each(rates.scans_dropped, status.scans_dropped, "dropped, ")
    yield "SCANS|/s|total", [taken, ("bytes received", *received), *dropped]
    yield "MAP|", list(_map(sample, rates))
    yield "OPERATIONS|/s|p50 ms|p99 ms", list(_operations(sample, rates))
    yield (
        "SOURCES|/s|lost|heard",
        [
            (name, rate(rates.source_taken[name]), count(one.lost), f"{duration(one.age_s)} ago")
            for name, one in metrics.sources.items()
        ],
    )
    queues = [(n, one) for n, one in metrics.queues.items() if one.waiting or n == "scans"]
    yield "QUEUES|waiting|limit", [(n, count(one.waiting), count(one.limit)) for n, one in queues]
    yield "REQUESTS REFUSED|/s|total", _each(rates.refused, sample.refused)
    parts = sorted(metrics.memory_bytes.items(), key=lambda part: -part[1])
    memory = [("process", status.memory_bytes), ("map", status.map_bytes), *parts]
    yield "MEMORY|", [(name, size(number)) for name, number in memory if number]
    yield "POINTS DROPPED|/s|total", _each(rates.points_dropped, status.points_dropped)
    kinds = Counter(metrics.sessions.values()).items()
    yield "CONNECTED|", [(kind, count(number)) for kind, number in kinds]
    shares = rates.mapper_share.items()
    yield "MAPPER'S TIME|", [(name, f"{100.0 * share:.0f} %") for name, share in shares]


def _map(sample: Sample, rates: Rates) -> Iterator[tuple[str, str]]:
    status, checkpoints = sample.status, sample.metrics.checkpoints
    yield "epoch", f"{status.epoch:,}, {duration(sample.metrics.epoch_age_s)} old"
    yield "epochs /s", rate(rates.epochs)
    yield "samples /s", rate(rates.samples_trained)
    left = "nothing, settled" if status.settled else count(status.samples_left)
    if not status.settled and rates.samples_trained > 0.0:
        left += f", {duration(status.samples_left / rates.samples_trained)}"
    yield "samples left", left
    yield "loss", f"{status.loss:.4f}"
    if status.fit is not None:
        yield "held-out rays within", within(status.fit.median_m, status.fit.upper_m)
    yield "regions", count(status.regions)
    if status.last_checkpoint is not None:
        ago = "" if checkpoints.age_s is None else f", {duration(checkpoints.age_s)} ago"
        yield "last checkpoint", f"epoch {status.last_checkpoint.epoch:,}{ago}"
    yield "written, failed", f"{count(checkpoints.written)}, {count(checkpoints.failed)}"


def _operations(sample: Sample, rates: Rates) -> Iterator[tuple[str, ...]]:
    """Yield a row for each operation that was ever answered, the most frequent first."""
    for name, total in sorted(sample.each("operations.answered").items(), key=lambda one: -one[1]):
        times_s = (rates.p50_s[name], rates.p99_s[name])
        if total:
            times = ("-" if time_s is None else milliseconds(time_s) for time_s in times_s)
            yield name.rpartition("/")[2], rate(rates.answered[name]), *times


def _each(per_s: Mapping[str, float], totals: Mapping[str, int], prefix: str = "") -> Rows:
    """Return a row for each count, the largest first."""
    largest_first = sorted(totals.items(), key=lambda item: -item[1])
    return [(prefix + name, rate(per_s[name]), count(total)) for name, total in largest_first]


def _table(titles: str, rows: Rows) -> Table:
    name, *figures = titles.split("|")
    table = Table(
        box=None, expand=True, padding=(0, 0, 0, _GAP), pad_edge=False, header_style="bold cyan"
    )
    table.add_column(name, ratio=1, min_width=12, no_wrap=True, overflow="ellipsis")
    for title in figures:
        table.add_column(title, justify="right", no_wrap=True, overflow="ellipsis")
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    return table
