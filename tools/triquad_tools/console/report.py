"""Results for people, as tables, and for programs, as JSON."""

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Any


@dataclass(frozen=True)
class Row:
    """One line of a table."""

    name: str
    value: str
    note: str = ""


def print_table(title: str, rows: Sequence[Row]) -> None:
    """Print rows under a title to standard output."""
    names = max((len(row.name) for row in rows), default=0)
    values = max((len(row.value) for row in rows), default=0)
    print(title)
    for row in rows:
        line = f"  {row.name:<{names}}  {row.value:>{values}}"
        print(f"{line}  {row.note}".rstrip())


def print_columns(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table under titles: the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(titles, *rows, strict=True)]
    for row in (titles, *rows):
        cells = [f"{cell:>{width}}" for cell, width in zip(row[1:], widths[1:], strict=True)]
        print("  ".join(["", f"{row[0]:<{widths[0]}}", *cells]).rstrip())


def json_text(value: object) -> str:
    """Records, lists and numbers as JSON; what is not finite becomes null."""
    return json.dumps(_plain(value), indent=2)


def centimetres(metres: float) -> str:
    """A length in centimetres, to a tenth of a millimetre."""
    return f"{100.0 * metres:.2f} cm"


def percent(share: float) -> str:
    """A share in percent."""
    return f"{100.0 * share:.2f} %"


def utc_time(stamp_ns: int) -> str | None:
    """A time in nanoseconds since 1970 as in RFC 3339; ``None`` for 0, a time that is not known."""
    if not stamp_ns:
        return None
    return datetime.fromtimestamp(stamp_ns // 10**9, timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ")


def _plain(value: object) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
