"""The names of recorded files: their order, and the times at which they were taken."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

_NUMBERS = re.compile(r"(\d+)")
_NS_OF_DIGITS = {10: 10**9, 13: 10**6, 16: 10**3, 19: 1}
"""Whole numbers with as many digits are times since 1970, from 2001 to 2286, in a unit of
nanoseconds: seconds, milliseconds, microseconds or nanoseconds."""

_WHOLE = re.compile(r"(?:.*\D)?([1-9]\d+)")
_DECIMAL = re.compile(r"(?:.*[^\d.])?(\d{1,10})\.(\d{1,9})")
_PAIR = re.compile(r"(?:.*\D)?([1-9]\d{9})[_-](\d{1,9})")
_PLACES = (3, 6, 9)  # decimal places of milliseconds, microseconds and nanoseconds


def in_order(paths: Iterable[Path]) -> list[Path]:
    """Return paths in the order of the numbers in their names: 2 before 10, padded or not.

    Hidden files are left out: macOS adds one to each that it copies.
    """
    shown = (path for path in paths if not path.name.startswith("."))
    return sorted(shown, key=lambda path: _key(path.name))


def _key(name: str) -> list[tuple[int, str]]:
    parts = _NUMBERS.split(name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def stamps_of_names(paths: Sequence[Path]) -> list[int] | None:
    """Return nanoseconds that the names of all files say; None where any of them says none.

    A time is the last number of a name: ``1700000000.25``, ``1700000000250000000`` or
    ``1700000000_250000000``, seconds and a fraction of them in whole units. Small whole numbers
    are counts, not times, and so are those that begin with 0.
    """
    pairs = [_PAIR.fullmatch(path.stem) for path in paths]
    longest = max((len(pair[2]) for pair in pairs if pair), default=0)
    unit_ns = next(10 ** (9 - places) for places in _PLACES if places >= longest)
    stamps: list[int] = []
    for path, pair in zip(paths, pairs, strict=True):
        stamp = _stamp_of(path.stem) if pair is None else _stamp_of_pair(pair, unit_ns)
        if stamp is None:
            return None
        stamps.append(stamp)
    return stamps


def _stamp_of_pair(pair: re.Match[str], unit_ns: int) -> int:
    return int(pair[1]) * 10**9 + int(pair[2]) * unit_ns


def _stamp_of(stem: str) -> int | None:
    decimal = _DECIMAL.fullmatch(stem)
    if decimal is not None:
        return int(decimal[1]) * 10**9 + int(decimal[2].ljust(9, "0"))
    whole = _WHOLE.fullmatch(stem)
    unit_ns = None if whole is None else _NS_OF_DIGITS.get(len(whole[1]))
    return None if whole is None or unit_ns is None else int(whole[1]) * unit_ns
