"""Progress for the user: bars on a terminal, plain lines elsewhere."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, TextColumn
from triquad_format.printable import printable

from triquad_tools.console.command import print_remark

Report = Callable[[float, str], None]  # takes how much is done, in units of the total, and a remark
_LINE_PERIOD_S = 10.0


@contextmanager
def progress(title: str, total: float | None = None) -> Iterator[Report]:
    """Show the progress of a step on standard error, and how long it will take."""
    in_lines, started_s = not sys.stderr.isatty(), time.monotonic()
    columns = *Progress.get_default_columns(), TextColumn("{task.fields[note]}", markup=False)
    bars = Progress(*columns, console=Console(stderr=True), disable=in_lines)
    bars.add_task(escape(printable(title)), total=total, note="")
    (task,) = bars.tasks
    due_s = started_s + _LINE_PERIOD_S
    if in_lines:
        print_remark(f"{title} ...")

    def state() -> str:
        share = "" if total is None else f"{task.percentage:.0f}% "
        return f"{share}{task.fields['note']}".strip()

    def report(done: float, note: str) -> None:
        nonlocal due_s
        bars.update(task.id, completed=done, note=printable(note))
        if in_lines and time.monotonic() >= due_s:
            due_s = time.monotonic() + _LINE_PERIOD_S
            left_s = task.time_remaining
            left = "" if left_s is None else f", {left_s:.0f} s left"
            print_remark(f"  {title}: {state()}{left}")

    with bars:
        yield report
        if total is None:
            bars.update(task.id, total=1.0, completed=1.0)
    if in_lines:
        end = f"  {title}: done in {time.monotonic() - started_s:.1f} s"
        print_remark(", ".join(filter(None, (end, state()))))
