"""A part of the page: lines of figures under a title."""

from collections.abc import Mapping
from dataclasses import dataclass

from triquad_tools.top.amounts import count, rate
from triquad_tools.top.problems import Grade

NONE_YET = "-"
"""Stands where a figure is not known, or not yet."""


@dataclass(frozen=True)
class Row:
    """A line: what it is about, and its figures."""

    name: str
    values: tuple[str, ...]
    grade: Grade = Grade.GOOD


@dataclass(frozen=True)
class Section:
    """Lines under a title, with titles of the figures."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]


def counted(name: str, total: int, per_s: float | None, worsening: Grade = Grade.GOOD) -> Row:
    """A line of a count: how many a second, and in all; graded while it rises."""
    shown = NONE_YET if per_s is None else rate(per_s)
    return Row(name, (shown, count(total)), worsening if per_s else Grade.GOOD)


def counted_each(
    prefix: str,
    totals: Mapping[str, int],
    per_s: Mapping[str, float] | None,
    worsening: Grade = Grade.GOOD,
) -> tuple[Row, ...]:
    """A line for each of some counts, the largest first."""
    rates = {} if per_s is None else per_s
    largest_first = sorted(totals.items(), key=lambda item: (-item[1], item[0]))
    return tuple(
        counted(f"{prefix}{name}", total, rates.get(name), worsening)
        for name, total in largest_first
    )
