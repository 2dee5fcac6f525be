"""The page, drawn: what stands out first, then parts in as many columns as there is room for."""

import time
from collections.abc import Iterator
from dataclasses import dataclass

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.segment import Segment
from rich.table import Table
from rich.text import Text
from triquad_format.printable import printable

from triquad_tools.top.amounts import duration
from triquad_tools.top.asked import asked
from triquad_tools.top.incoming import incoming
from triquad_tools.top.inside import inside
from triquad_tools.top.interval import Interval
from triquad_tools.top.problems import Grade, Problem, problems
from triquad_tools.top.section import Section
from triquad_tools.top.taken_up import taken_up
from triquad_tools.top.watch import Silence, Target

_COLUMN_WIDTH = 39  # characters that a part needs
_GAP = 2  # characters between columns
_SIGNS = {Grade.GOOD: "   ", Grade.WARNING: "!  ", Grade.ERROR: "!! "}
_LEAST_NAME = 12  # characters of a line's name that are shown in any case
_STYLES = {Grade.GOOD: "", Grade.WARNING: "bold yellow", Grade.ERROR: "bold red"}
_TITLE, _STALE = "bold cyan", "dim"

Lines = list[list[Segment]]


@dataclass(frozen=True)
class Page:
    """What is known of a server: the newest interval, and whether it answers."""

    target: Target
    seen: Interval | None  # None: nothing yet
    silence: Silence | None = None
    height: int | None = None  # lines, to which it is cut; None: it is drawn whole

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """As wide as the terminal."""
        options = options.reset_height()  # else lines are filled up to it
        head = console.render_lines(self._head(), options)
        left = None
        if self.height is not None:
            head = _cut(head, max(2, self.height // 2), console, options)
            left = max(1, self.height - len(head))
        body = self._body(console, options, left)
        for line in head + body:
            yield from line
            yield Segment.line()

    def _head(self) -> RenderableType:
        lines: list[RenderableType] = [self._title()]
        lines += [_problem(problem) for problem in self._problems()]
        if self.seen is not None and self.seen.sample.metrics_missing is not None:
            lines.append(_text(f"   {self.seen.sample.metrics_missing}"))
        return Group(*lines)

    def _title(self) -> RenderableType:
        title = Table.grid(expand=True, padding=(0, _GAP, 0, 0))
        title.add_column(ratio=1, no_wrap=True, overflow="ellipsis")
        title.add_column(justify="right", no_wrap=True)
        name = _text(f"map {self.target.map_name} at {self.target.endpoint}", "bold")
        title.add_row(name.append(_server(self.seen), ""), _time_of_day(time.time()))
        return title

    def _problems(self) -> tuple[Problem, ...]:
        if self.silence is not None:
            return (Problem(Grade.ERROR, _unanswered(self.silence)),)
        return () if self.seen is None else problems(self.seen)

    def _body(self, console: Console, options: ConsoleOptions, height: int | None) -> Lines:
        """The parts; closer together where they do not fit, and cut where that is not enough."""
        if self.seen is None:
            return []
        groups = (incoming(self.seen), inside(self.seen), asked(self.seen), taken_up(self.seen))
        style = console.get_style(_STALE if self.silence else "none")

        def drawn(spaced: bool) -> Lines:
            columns = _columns(groups, options.max_width, spaced=spaced)
            return console.render_lines(columns, options, style=style)

        lines = drawn(spaced=True)
        if height is None or len(lines) <= height:
            return lines
        return _cut(drawn(spaced=False), height, console, options)


def _unanswered(silence: Silence) -> str:
    silent_s = time.monotonic() - silence.since_s
    since = _time_of_day(time.time() - silent_s)
    return f"no answer since {since}, for {duration(silent_s)}: {silence.reason}"


def _time_of_day(stamp_s: float) -> str:
    return time.strftime("%H:%M:%S", time.localtime(stamp_s))


def _server(seen: Interval | None) -> str:
    if seen is None:
        return ""
    status = seen.sample.status
    up = f"up {duration(status.uptime_s)}"
    return printable(f", triquad {status.version} on {status.device}, {up}")


def _problem(problem: Problem) -> RenderableType:
    """A sign, and the text folded beside it."""
    line = Table.grid()
    line.add_column(no_wrap=True)
    line.add_column(overflow="fold")
    style = _STYLES[problem.grade]
    line.add_row(_text(_SIGNS[problem.grade], style), _text(problem.text, style))
    return line


def _columns(groups: tuple[tuple[Section, ...], ...], width: int, *, spaced: bool) -> Table:
    """The groups side by side; where there is no room for all, the last ones below the first."""
    number = max(1, min(len(groups), (width + _GAP) // (_COLUMN_WIDTH + _GAP)))
    beside = Table.grid(expand=True, padding=(0, _GAP, 0, 0))
    for _ in range(number):
        beside.add_column(ratio=1)
    stacks: list[list[RenderableType]] = [[] for _ in range(number)]
    for position, group in enumerate(groups):
        for section in group:
            stacks[position % number] += _section(section, spaced)
    beside.add_row(*(Group(*stack) for stack in stacks))
    return beside


def _section(section: Section, spaced: bool) -> Iterator[RenderableType]:
    """A table, perhaps with an empty line below; nothing where it has no lines."""
    if not section.rows:
        return
    table = Table(
        box=None, expand=True, padding=(0, 0, 0, _GAP), pad_edge=False, header_style=_TITLE
    )
    name = f"{_SIGNS[Grade.GOOD]}{section.title}"
    table.add_column(name, ratio=1, min_width=_LEAST_NAME, no_wrap=True, overflow="ellipsis")
    for title in section.columns:
        table.add_column(title, justify="right", no_wrap=True, overflow="ellipsis")
    for row in section.rows:
        cells = (f"{_SIGNS[row.grade]}{row.name}", *row.values)
        table.add_row(*(_text(cell) for cell in cells), style=_STYLES[row.grade])
    yield table
    if spaced:
        yield _text("")


def _text(text: str, style: str = "") -> Text:
    return Text(printable(text), style)


def _cut(lines: Lines, height: int, console: Console, options: ConsoleOptions) -> Lines:
    """The first lines, with a word of how many are left out."""
    if len(lines) <= height:
        return lines
    hidden = len(lines) - height + 1
    note = _text(f"   {hidden} more lines: make the window larger, or use --once", "reverse")
    note.no_wrap, note.overflow = True, "ellipsis"
    return lines[: height - 1] + console.render_lines(note, options)
