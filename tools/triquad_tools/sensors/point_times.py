"""The time of each point in a cloud, which every driver writes in its own way."""

import re
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles

_KNOWN = ("t", "time", "timestamp", "offset_time", "time_offset", "time_stamp", "stamp")
"""Names under which drivers write it: Ouster; Velodyne; Hesai and RoboSense; Livox; others."""

_LIKELY = re.compile(r".*(time|stamp).*|(d|rel_?)?t_?(offset)?(_?[nmu]?s(ec)?)?|offset(_?[nmu]?s)?")
_UNIT_IN_NAME = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3}

_UNITS_S = (1.0, 1e-3, 1e-6, 1e-9)
_ENOUGH = 4096  # points, to determine the unit
_MIN_SWEEP_S, _MAX_SWEEP_S = 3e-3, 2.0
"""The limits of a sweep's duration. Less than a factor of 1000 apart, they fit one unit at most."""


def time_fields(names: Iterable[str]) -> list[str]:
    """Return those of the fields of a cloud that may be times, the likeliest first."""
    likely = [name for name in names if _LIKELY.fullmatch(name.lower())]
    return sorted(likely, key=lambda name: (*_KNOWN, name).index(name))


def offsets_s(values: NDArray[Any], stamp_ns: int, name: str = "") -> Doubles | None:
    """Return seconds [N] after the stamp of the cloud; None where there is no sense in the values.

    Drivers write seconds, milliseconds, microseconds or nanoseconds, since the stamp, since the
    first point, or since 1970; which it is follows from the name of the field, from how long a
    sweep can take and from how large the values are.
    """
    times: Doubles = values.astype(np.float64)
    if len(times) == 0 or not np.isfinite(times.sum()):
        return None
    some = times[:: max(1, len(times) // _ENOUGH)]
    typical = float(np.median(some))
    unit_s = _unit_s(some - typical, name)
    if unit_s is None:
        return None
    spread = times
    spread -= typical
    spread *= unit_s
    if spread.max() - spread.min() > _MAX_SWEEP_S:
        # Points that drivers leave empty have the time 0, also where that of others is absolute.
        spread[np.abs(spread) > _MAX_SWEEP_S] = 0.0
    centre_s = typical * unit_s
    if abs(centre_s) > _MAX_SWEEP_S:
        centre_s -= stamp_ns / 1e9
        if abs(centre_s) > _MAX_SWEEP_S:  # of a clock that is not the one of the stamps
            centre_s = -float(spread.min())
    spread += centre_s
    return spread


def _unit_s(spread: Doubles, name: str) -> float | None:
    """Return the unit in which most points lie within one sweep: the one that the name says."""
    units = [unit for ending, unit in _UNIT_IN_NAME.items() if name.lower().endswith(f"_{ending}")]
    low, high = np.quantile(spread, (0.02, 0.98))
    length = high - low
    fitting = [unit for unit in units or _UNITS_S if _MIN_SWEEP_S <= length * unit <= _MAX_SWEEP_S]
    return fitting[0] if fitting else None
