"""Progress for the user: bars on a terminal, plain lines elsewhere."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

from triquad_format.printable import printable

from triquad_tools.console.lines import print_remark

Report = Callable[[float, str], None]
"""Takes how much is done, in the units of the total, and a remark."""


_LINE_PERIOD_S = 10.0


def progress(title: str, total: float | None = None) -> AbstractContextManager[Report]:
    """Show the progress of a step on standard error, and how long it will take.

    Without a total it shows that it goes on.
    """
    show = _bar if sys.stderr.isatty() else _lines
    return show(title, total)


@contextmanager
def _bar(title: str, total: float | None) -> Iterator[Report]:
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import Progress, TextColumn

    columns = *Progress.get_default_columns(), TextColumn("{task.fields[note]}", markup=False)
    with Progress(*columns, console=Console(stderr=True)) as bars:
        task = bars.add_task(escape(printable(title)), total=total, note="")

        def report(done: float, note: str) -> None:
            bars.update(task, completed=done, note=printable(note))

        yield report
        if total is None:
            bars.update(task, total=1.0, completed=1.0)


@contextmanager
def _lines(title: str, total: float | None) -> Iterator[Report]:
    started = time.monotonic()
    next_line = started + _LINE_PERIOD_S
    latest = ""
    first: tuple[float, float] | None = None  # when it was first reported, and how much was done
    print_remark(f"{title} ...")

    def report(done: float, note: str) -> None:
        nonlocal next_line, latest, first
        first = first or (time.monotonic(), done)
        share = "" if total is None else f"{min(done / max(total, 1e-9), 1.0):.0%} "
        latest = f"{share}{note}".strip()
        if time.monotonic() >= next_line:
            next_line = time.monotonic() + _LINE_PERIOD_S
            since_s, since = time.monotonic() - first[0], done - first[1]
            left = f", {(total - done) * since_s / since:.0f} s left" if total and since > 0 else ""
            print_remark(f"  {title}: {latest}{left}")

    yield report
    end = f"  {title}: done in {time.monotonic() - started:.1f} s"
    print_remark(f"{end}, {latest}" if latest else end)
