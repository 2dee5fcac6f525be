"""``triquad-top``: how a map server is doing, live."""

import argparse
import io
import itertools
import math
import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text
from triquad_client import Client, ServerMetrics, ServerStatus
from triquad_format.errors import TriquadError
from triquad_format.mapfile.metadata import utc_time
from triquad_format.printable import printable

from triquad_tools.commands.top import COMMAND
from triquad_tools.console.amounts import count, duration, milliseconds, rate, size, within
from triquad_tools.console.arguments import connect_to, server_name
from triquad_tools.console.command import FAILED, OK, complain, print_line
from triquad_tools.console.report import json_text

_TIMEOUT_S = 5.0  # for connecting, and for each reply
_PLAIN_WIDTH = 100  # characters, where neither a terminal nor COLUMNS says otherwise
_SILENT_S = 5.0  # of a source, while others are active
_NEARLY_FULL = 0.9  # of what the map may take


@dataclass(frozen=True)
class Sample:
    """What a server said of itself, and what it had said an interval before."""

    status: ServerStatus
    metrics: ServerMetrics
    before: "Sample | None" = None  # None: there is none of the same server, so there are no rates
    silent: str | None = None  # why it does not answer any more

    @property
    def counts(self) -> dict[str, int]:
        """What is counted since the server started, by name."""
        status, metrics = self.status, self.metrics
        found = {"scans taken": status.scans_taken, "samples trained": status.samples_trained}
        found["scan bytes received"] = metrics.scan_bytes_received
        for what, by_reason in (
            ("scans refused", status.scans_dropped),
            ("scans lost of", status.scans_lost),
            ("points dropped", status.points_dropped),
        ):
            found |= {f"{what}: {reason}": number for reason, number in by_reason.items()}
        for name, operation in metrics.operations.items():
            found[name] = operation.answered
            found |= {f"{name}: {code}": number for code, number in operation.refused.items()}
        return found

    @property
    def per_s(self) -> dict[str, float]:
        """The rates of the counts over the last interval, by the server's clock."""
        seconds = self.metrics.uptime_s - self.before.metrics.uptime_s if self.before else 0.0
        if self.before is None or not 0.0 < seconds < math.inf:
            return {}
        was = self.before.counts
        # Counts of sources that are removed shrink.
        grown = {name: max(0, n - was.get(name, 0)) for name, n in self.counts.items()}
        return {name: more / seconds for name, more in grown.items()}

    def after(self, status: ServerStatus, metrics: ServerMetrics) -> "Sample":
        """Return the next sample."""
        same = status.server == self.status.server
        return Sample(status, metrics, replace(self, before=None) if same else None)


def work(options: argparse.Namespace) -> int:
    """Show how a server is doing."""
    server = server_name(options)
    can_draw = sys.stdout.isatty() and os.environ.get("TERM") != "dumb"
    with connect_to(options, timeout_s=_TIMEOUT_S) as client:
        name = client.map_name
        title = f"map {name} at {server}"
        samples = _samples(client, options.interval)
        if options.once or not (options.json or can_draw):
            samples = itertools.islice(samples, 1, 2)
        elif can_draw and not options.json:
            with Live(screen=True, auto_refresh=False) as live:
                for sample in samples:
                    live.update(page(title, sample), refresh=True)
        for sample in samples:
            if options.once and sample.silent is not None:
                return complain(COMMAND, sample.silent, FAILED)
            print_line(_json_line(server, name, sample) if options.json else _plain(title, sample))
    return OK


def _samples(client: Client, period_s: float) -> Iterator[Sample]:
    """Yield what a server says, at each interval; one that does not answer is waited for."""
    sample, due_s = Sample(client.status(), client.metrics()), time.monotonic()
    answered_s = due_s
    while True:
        yield sample
        due_s = max(due_s + period_s, time.monotonic())
        time.sleep(max(0.0, due_s - time.monotonic()))
        try:
            sample, answered_s = sample.after(client.status(), client.metrics()), time.monotonic()
        except TriquadError as error:
            silent_s = time.monotonic() - answered_s
            sample = replace(sample, silent=f"no answer for {duration(silent_s)}: {error}")


def problems(sample: Sample) -> Iterator[str]:
    """Yield what is out of order now, in whole sentences, most serious first."""
    status, metrics, per_s = sample.status, sample.metrics, sample.per_s
    yield from filter(None, (sample.silent, metrics.problem))
    for name, queue in metrics.queues.items():
        if queue.waiting >= queue.limit > 0:
            yield f"the queue of {name} is full: {count(queue.waiting)} wait"
    most = status.map_max_bytes
    if status.memory_bytes >= _NEARLY_FULL * most > 0 and status.regions_cold == 0:
        yield f"memory nears {size(most)}: beyond, scans are refused where regions cannot leave it"
    ages_s = {name: source.age_s for name, source in metrics.sources.items()}
    for name, age_s in ages_s.items():
        if age_s >= _SILENT_S > min(ages_s.values()):
            yield f"source {name} is silent for {duration(age_s)}"
    yield from status.warnings
    for name, number in per_s.items():
        if number > 0.0 and name.startswith(("scans refused", "scans lost")):
            yield f"{name}, {rate(number)} a second"
        elif number > 0.0 and name.endswith((": busy", ": internal")):  # not the client's fault
            yield f"{name}, {rate(number)} requests a second are refused"


def page(title: str, sample: Sample) -> Group:
    """Draw what is known of a server; ``title`` says which it is."""
    status = sample.status
    up = f"triquad {status.version} on {status.device}, up {duration(status.uptime_s)}"
    head = [Text(printable(f"{title}, {up}"), "bold")]
    head += [Text(printable(f"!! {problem}"), "bold red") for problem in problems(sample)]
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style="bold cyan")
    table.add_column(no_wrap=True, overflow="ellipsis")
    for column in ("now or total", "/s", "p50 ms", "p99 ms"):
        table.add_column(column, justify="right", no_wrap=True)
    dim = "dim" if sample.silent else ""
    for row in _rows(sample):
        table.add_row(*(Text(printable(cell)) for cell in row), style=dim)
    return Group(*head, table)


def _rows(sample: Sample) -> Iterator[Sequence[str]]:
    """Yield the state of the map, then what is counted, then what waits and takes memory."""
    status, metrics = sample.status, sample.metrics
    yield "epoch", f"{status.epoch:,}, {duration(metrics.epoch_age_s)} old"
    yield "samples left", "nothing, settled" if status.settled else count(status.samples_left)
    if status.origin_m is not None and status.origin_m.any():
        yield "origin", "{:.12g} {:.12g} {:.12g} m".format(*status.origin_m)
    if status.fit is not None:
        yield "held-out rays within", within(status.fit.median_m, status.fit.upper_m)
    if status.last_checkpoint is not None:
        age_s = metrics.checkpoints.age_s
        ago = "" if age_s is None else f", {duration(age_s)} ago"
        yield "last checkpoint", f"epoch {status.last_checkpoint.epoch:,}{ago}"
    if (kept := status.kept_scans) is not None:
        since = "" if kept.since_ns is None else f" since {kept.since_ns / 1e9:.3f} s"
        yield "kept scans", size(kept.bytes) + since
    per_s = sample.per_s
    for name, number in sample.counts.items():
        if number:
            yield (name, count(number), rate(per_s[name]) if per_s else "", *_times(sample, name))
    for name, source in metrics.sources.items():
        yield f"source {name}", f"heard {duration(source.age_s)} ago"
    for name, queue in metrics.queues.items():
        if queue.waiting:
            yield f"queue of {name}", f"{count(queue.waiting)} of {count(queue.limit)}"
    yield "memory of process", size(status.memory_bytes)
    for name, nbytes in status.memory_parts.items():
        if nbytes:
            yield f"memory of {name}", size(nbytes)


def _times(sample: Sample, name: str) -> Iterator[str]:
    """Yield the times within which half and 99 % of an operation's answers went out."""
    if name in sample.metrics.operations and sample.before is not None:
        for share in (0.5, 0.99):
            time_s = sample.metrics.answer_time_s(name, share, since=sample.before.metrics)
            yield "-" if time_s is None else milliseconds(time_s)


def _plain(title: str, sample: Sample) -> str:
    has_width = sys.stdout.isatty() or "COLUMNS" in os.environ
    width = None if has_width else _PLAIN_WIDTH
    console = Console(width=width, file=io.StringIO(), color_system=None)
    with console.capture() as captured:
        console.print(page(title, sample))
    return "\n".join(line.rstrip() for line in captured.get().splitlines())


def _json_line(server: str, name: str, sample: Sample) -> str:
    """Return an object in one line, with the same keys whether the server answers or not."""
    said = None if sample.silent else sample
    report: dict[str, object] = {"time": utc_time(time.time_ns()), "endpoint": server, "map": name}
    report |= {"silent": sample.silent, "problems": list(problems(sample))}
    report |= {"per_s": said and said.per_s, "status": said and said.status}
    return json_text({**report, "metrics": said and said.metrics}, indent=None)
