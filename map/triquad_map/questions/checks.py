"""Checks of what requests carry: what is out of bounds is refused with its value and a remedy."""

import numpy as np
from triquad_format.errors import RefusedError
from triquad_format.records.arrays import Doubles, Floats
from triquad_format.wire.limits import MAX_POSITION_M, MIN_LENGTH_M

_DECIMALS = 5  # of positions, metres


def check_box(minimum: Doubles, maximum: Doubles) -> None:
    """Refuse a box [3], [3] with NaN or with corners the wrong way round; infinite is allowed.

    Raises:
        RefusedError: it is such a box.
    """
    if np.isnan([minimum, maximum]).any() or (minimum > maximum).any():
        raise RefusedError("bad_request", f"not a box: minimum {minimum}, maximum {maximum}")


def points(what: str, origin: Doubles, offsets: Floats, most: int) -> Doubles:
    """Return the points [N, 3] at ``offsets`` [N, 3] from an origin [3], map frame.

    Raises:
        RefusedError: they are too many, or not all of them are places.
    """
    if len(offsets) > most:
        raise RefusedError(
            "too_large", f"{len(offsets)} points exceed the limit of {most}: split the request"
        )
    points = origin + offsets.astype(np.float64)
    # Of NaN, neither is true.
    if points.min(initial=0.0) >= -MAX_POSITION_M and points.max(initial=0.0) <= MAX_POSITION_M:
        # Single precision from an origin is good to that. Unrounded, a point that somebody chose on
        # a face of voxels would lie on one side or the other by what else is in the request.
        rounded: Doubles = np.round(points, _DECIMALS)
        return rounded
    index = int((np.abs(points) <= MAX_POSITION_M).all(axis=1).argmin())
    if not np.isfinite(points[index]).all():
        raise RefusedError("bad_request", f"{what} {index} is not finite: {points[index]}")
    raise RefusedError(
        "bad_request",
        f"{what} {index} is {points[index]}: use coordinates up to {MAX_POSITION_M:g} m",
    )


def within(name: str, value: float, most: float, least: float = MIN_LENGTH_M) -> float:
    """Return a value from ``least`` to ``most``; refuse another, as NaN is."""
    if not least <= value <= most:
        raise RefusedError("bad_request", f"{name} = {value}: use {least:g} to {most:g}")
    return float(value)


def same_length(first: Floats, name: str, second: Floats) -> None:
    """Refuse arrays of different lengths; ``second`` is called ``name``."""
    if len(first) != len(second):
        raise RefusedError("bad_request", f"{len(second)} {name} for {len(first)} points")
