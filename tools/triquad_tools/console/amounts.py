"""Amounts as people read them: three digits and a unit."""

import math

_SCALES = ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k"))
_LEAST_SCALED = 10_000.0  # less is shown without a prefix

_MINUTE, _HOUR, _DAY = 60, 3_600, 86_400  # seconds


def count(number: int) -> str:
    """Show how many of something there are, such as ``9,999`` and ``12.3 k``."""
    return f"{number:,}" if number < _LEAST_SCALED else _scaled(float(number))


def rate(per_s: float) -> str:
    """Show how many of something happen a second, such as ``0.25``, ``12.5`` and ``812 k``."""
    return _three_digits(per_s) if per_s < _LEAST_SCALED else _scaled(per_s)


def size(number_bytes: float) -> str:
    """Show bytes, such as ``812 B``, ``40.1 kB`` and ``1.24 GB``."""
    scaled = _scaled(number_bytes)
    return f"{scaled}B" if scaled[-1].isalpha() else f"{scaled} B"


def duration(seconds: float) -> str:
    """Show a time, such as ``0.4 s``, ``32 s``, ``5 min 12 s`` and ``3 h 12 min``."""
    if not math.isfinite(seconds):
        return str(seconds)
    if round(seconds, 1) < 10.0:
        return f"{seconds:.1f} s"
    left = round(seconds)
    if left < _MINUTE:
        return f"{left} s"
    if left < _HOUR:
        return f"{left // _MINUTE} min {left % _MINUTE} s"
    if left < _DAY:
        return f"{left // _HOUR} h {left % _HOUR // _MINUTE} min"
    return f"{left // _DAY} d {left % _DAY // _HOUR} h"


def milliseconds(seconds: float) -> str:
    """Show a short time in milliseconds, without the unit: ``0.85``, ``4.20``, ``1,200``."""
    return _three_digits(1e3 * seconds)


def within(median_m: float, upper_m: float) -> str:
    """Show within what distance half and 90 % of rays end: ``4.21 mm, 90 % in 12.3 mm``."""
    return f"{millimetres(median_m)}, 90 % in {millimetres(upper_m)}"


def millimetres(metres: float) -> str:
    """Show a short length, such as ``0.42 mm`` and ``12.3 mm``."""
    return f"{_three_digits(1e3 * metres)} mm"


def _scaled(value: float) -> str:
    for scale, prefix in _SCALES:
        if float(f"{value:.3g}") >= scale:
            return f"{_three_digits(value / scale)} {prefix}"
    return _three_digits(value)


def _three_digits(value: float) -> str:
    if 0.0 < value < 0.01:
        return "<0.01"
    rounded = float(f"{value:.3g}")
    if rounded >= 100.0 or rounded == 0.0:
        return f"{rounded:,.0f}"
    return f"{rounded:.1f}" if rounded >= 10.0 else f"{rounded:.2f}"
