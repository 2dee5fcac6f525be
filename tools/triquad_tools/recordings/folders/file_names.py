"""What the names of files say: their order, and when each was written."""

import re
from collections.abc import Iterable, Sequence
from datetime import datetime, timezone
from pathlib import Path

from triquad_tools.recordings.text_lines import NS_OF_DIGITS

_NUMBERS = re.compile(r"(\d+)")
_DATE = re.compile(
    r"(?:.*\D)?(?:(?P<y>\d{4})[-_.]?(?P<m>\d\d)[-_.]?(?P<d>\d\d)"
    r"|(?P<d2>\d\d)[-_.](?P<m2>\d\d)[-_.](?P<y2>\d{4}))"
    r"[-_.T ]+(?P<h>\d\d)[-_.:]?(?P<min>\d\d)[-_.:]?(?P<s>\d\d)\.(?P<ns>\d{1,9})"
)
_WHOLE = re.compile(r"(?:.*\D)?([1-9]\d+)")
_DECIMAL = re.compile(r"(?:.*[^\d.])?(\d{1,10})\.(\d{1,9})")
_PAIR = re.compile(r"(?:.*\D)?([1-9]\d{9})[_-](\d{1,9})")
_PLACES = (3, 6, 9)  # decimal places of milliseconds, microseconds and nanoseconds


def in_order(paths: Iterable[Path]) -> list[Path]:
    """Return paths in the order of the numbers in their names: 2 before 10, padded or not.

    Hidden files are left out: macOS adds one to each that it copies.
    """

    def key(path: Path) -> list[tuple[int, str]]:
        parts = _NUMBERS.split(path.name)
        return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]

    return sorted((path for path in paths if not path.name.startswith(".")), key=key)


def stamps_of_names(paths: Sequence[Path]) -> list[int] | None:
    """Return nanoseconds that the names of all files say; None where any of them says none.

    A time is the last number of a name: ``1700000000.25``, ``1700000000250000000`` or
    ``1700000000_250000000``, seconds and a fraction of them in whole units; or a date and a time of
    day with a fraction. Small whole numbers are counts, not times, and so are those that begin
    with 0.
    """
    stems = [path.stem.removesuffix(".pcd") for path in paths]  # nuScenes: .pcd.bin
    pairs = [_PAIR.fullmatch(stem) for stem in stems]
    longest = max((len(pair[2]) for pair in pairs if pair), default=0)
    unit_ns = next(10 ** (9 - places) for places in _PLACES if places >= longest)
    stamps: list[int] = []
    is_padded = _are_padded([found[2] for stem in stems if (found := _DECIMAL.fullmatch(stem))])
    for stem, pair in zip(stems, pairs, strict=True):
        stamp = _stamp_of(stem, is_padded=is_padded)
        if pair is not None:
            stamp = int(pair[1]) * 10**9 + int(pair[2]) * unit_ns
        if stamp is None:
            return None
        stamps.append(stamp)
    return stamps


def _are_padded(fractions: Sequence[str]) -> bool:
    """Return whether fractions of seconds are decimals, not whole numbers of nanoseconds.

    Whole numbers differ in length, never begin with 0, and may end with it.
    """
    ends_with_0 = any(len(each) > 1 and each.endswith("0") for each in fractions)
    begins_with_0 = any(each.startswith("0") and each != "0" for each in fractions)
    return begins_with_0 or not ends_with_0 or len({*map(len, fractions)}) == 1


def _stamp_of(stem: str, *, is_padded: bool) -> int | None:
    date = _DATE.fullmatch(stem)
    if date is not None:
        return _stamp_of_date(date)
    decimal = _DECIMAL.fullmatch(stem)
    if decimal is not None:
        before = stem[: decimal.start(1)]
        if len(decimal[1]) <= 2 and re.search(r"\d[-_:]?$", before):  # of a clock
            return None
        places = 9 if is_padded else 0
        return int(decimal[1]) * 10**9 + int(decimal[2].ljust(places, "0"))
    whole = _WHOLE.fullmatch(stem)
    unit_ns = None if whole is None else NS_OF_DIGITS.get(len(whole[1]))
    return None if whole is None or unit_ns is None else int(whole[1]) * unit_ns


def _stamp_of_date(date: re.Match[str]) -> int | None:
    """Return nanoseconds since 1970 of a date and a time of day, UTC; None: there is none such."""
    year, month, day = (date[name] or date[f"{name}2"] for name in ("y", "m", "d"))
    clock = int(date["h"]), int(date["min"]), int(date["s"])
    try:
        moment = datetime(int(year), int(month), int(day), *clock, tzinfo=timezone.utc)
    except ValueError:
        return None
    return int(moment.timestamp()) * 10**9 + int(date["ns"].ljust(9, "0"))
