"""Progress for the user: bars on a terminal, plain lines elsewhere."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass

from triquad_format.printable import printable

from triquad_tools.console.lines import print_remark

Report = Callable[[float, str], None]
"""Takes how much is done, in the units of the total, and a remark."""


_LINE_PERIOD_S = 10.0


@dataclass(frozen=True)
class Speed:
    """The speed of work, and its remaining time."""

    per_s: float
    left_s: float

    @classmethod
    def of(cls, done: float, left: float, seconds: float) -> "Speed":
        """Return the speed of work of which the given amount was done in ``seconds``."""
        per_s = done / max(seconds, 1e-9)
        return cls(per_s, left / max(per_s, 1e-9))


def progress(title: str, total: float | None = None) -> AbstractContextManager[Report]:
    """Show the progress of a step on standard error; without a total, that it goes on."""
    show = _bar if sys.stderr.isatty() else _lines
    return show(title, total)


@contextmanager
def _bar(title: str, total: float | None) -> Iterator[Report]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[note]}", markup=False),
    )
    with Progress(*columns, console=Console(stderr=True)) as bars:
        task = bars.add_task(printable(title), total=total, note="")

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
    print_remark(f"{title} ...")

    def report(done: float, note: str) -> None:
        nonlocal next_line, latest
        share = "" if total is None else f"{min(done / max(total, 1e-9), 1.0):.0%} "
        latest = f"{share}{note}".strip()
        if time.monotonic() >= next_line:
            next_line = time.monotonic() + _LINE_PERIOD_S
            print_remark(f"  {title}: {latest}")

    yield report
    end = f"  {title}: done in {time.monotonic() - started:.1f} s"
    print_remark(f"{end}, {latest}" if latest else end)
