"""Results for people, as tables, and for programs, as JSON."""

import dataclasses
import json
import math
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from rich.console import Console
from rich.table import Table
from triquad_format.printable import printable

from triquad_tools.console.command import print_line

_GAP = 2  # spaces before each column
_PIPE_WIDTH = 10_000  # characters: nothing is broken where a program reads
_CELL_WIDTH = 2_000  # of a text that others chose


@dataclass(frozen=True)
class Row:
    """One line of a table: a figure by its name."""

    name: str
    value: str
    note: str = ""


def print_rows(title: str, rows: Sequence[Row], align: Literal["left", "right"] = "right") -> None:
    """Print figures under a title to standard output."""
    table = _table()
    table.add_column()
    table.add_column(justify=align)
    table.add_column()
    for row in rows:
        table.add_row(*_cells([row.name, row.value, row.note]))
    print_line(printable(title, _CELL_WIDTH))
    _print(table)


def print_columns(
    titles: Sequence[str], rows: Sequence[Sequence[str]], words: Sequence[str] = ()
) -> None:
    """Print a table under titles: the first column and those of ``words`` to the left, the others
    to the right.

    Where the terminal is too narrow, titles are broken, but no cell is.
    """
    rows = [_cells(row) for row in rows]
    table = _table(show_header=True)
    columns = list(zip(titles, *rows, strict=True))
    narrow = sum(_GAP + max(map(len, column)) for column in columns) > _console().width
    to_the_left = {*titles[:1], *words}
    for title, *cells in columns:
        widest = max(map(len, cells), default=1)
        shown = textwrap.fill(title, widest, break_long_words=False) if narrow else title
        table.add_column(shown, justify="left" if title in to_the_left else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    _print(table)


def _cells(texts: Sequence[str]) -> list[str]:
    """Return texts that each stay in their cell, whatever is in them."""
    return [printable(text, _CELL_WIDTH) for text in texts]


def _table(show_header: bool = False) -> Table:
    """Return a table without rules or colours: each line can be searched for and cut up."""
    return Table(box=None, show_header=show_header, header_style="", padding=(0, 0, 0, _GAP))


def _console() -> Console:
    """Return a console as wide as the terminal; elsewhere so wide that lines are whole."""
    width = None if sys.stdout.isatty() else _PIPE_WIDTH
    return Console(markup=False, highlight=False, width=width)


def _print(table: Table) -> None:
    """Print within the terminal's width, if nothing is cut by that."""
    console = _console()
    unbounded = console.options.update(width=_PIPE_WIDTH)
    console.width = max(console.width, console.measure(table, options=unbounded).minimum)
    with console.capture() as captured:
        console.print(table)
    for line in captured.get().splitlines():
        print_line(line.rstrip())


def json_text(value: object, indent: int | None = 2) -> str:
    """Return records, lists, arrays and numbers as JSON; what is not finite becomes null."""
    return json.dumps(_plain(value), indent=indent)


def centimetres(metres: float) -> str:
    """Return a length in centimetres, to a tenth of a millimetre."""
    return f"{100.0 * metres:.2f} cm"


def percent(share: float) -> str:
    """Return a share in percent."""
    return f"{100.0 * share:.2f} %"


def _plain(value: object) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
