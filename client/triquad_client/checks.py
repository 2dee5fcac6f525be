"""Arguments turned into values of known type, shape and range.

What cannot be is refused with :class:`InvalidInputError`, of scans with :class:`InvalidScanError`.
Text and truth values are no numbers, though Python and numpy convert them, and masked values are
unknown.
"""

import math
import operator
import reprlib
import time
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from triquad_format.errors import InvalidInputError
from triquad_format.records.arrays import Doubles, Floats
from triquad_format.wire.limits import (
    LEVELS,
    MAX_DISTANCE_M,
    MAX_POSITION_M,
    MIN_LENGTH_M,
)
from triquad_map.questions.grid import GridShape

from triquad_client.errors import NO_NUMBER, InvalidScanError

Bounds: TypeAlias = tuple[Sequence[float], Sequence[float]]
"""Minimum and maximum corner of a box, metres, map frame; sides may be infinite."""

SHORTEST_S, LONGEST_S = 1e-3, 1e6  # that a request may take

_MAX_COLUMNS = 16  # of a scan's points: more is rather an array that was transposed
_MAX_CELLS = 100_000_000  # of a grid


def real_numbers(values: ArrayLike) -> NDArray[Any]:
    """Return an array of whole or floating numbers, or raise one of :data:`NO_NUMBER`."""
    if np.ma.is_masked(values):
        raise TypeError("some values are masked: fill them with NaN, or leave them out")
    columns = list(getattr(values, "columns", ()))  # of a table of pandas or polars
    if columns[:3] != ["x", "y", "z"] and any(isinstance(column, str) for column in columns):
        raise TypeError(f"a table with columns {columns}: give table[['x', 'y', 'z']]")
    array = np.asarray(values)
    if array.dtype.kind not in "fiu":
        example = repr(array.item(0))[:40] if array.size else "nothing"
        raise TypeError(f"{example} ({array.dtype}) is not a real number")
    return array


def real_number(value: Any) -> float:
    """Return a number as a float; an integer that is too large for one is infinite.

    Raises:
        TypeError, ValueError: it is none.
    """
    if isinstance(value, str | bytes | bool | np.bool_):
        raise TypeError("text, or a truth value")
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def whole_number(value: Any) -> int:
    """Return an integer, also one of numpy's; raise TypeError where it is none."""
    if isinstance(value, bool):
        raise TypeError("a truth value")
    return operator.index(value)


def query_points(points: ArrayLike) -> Doubles:
    """Return points [N, 3] as float64, finite, at most ``MAX_POSITION_M`` from 0 0 0."""
    array = _points(points, np.float64, InvalidInputError)
    # All at once, as point by point takes ten times as long.
    if not np.isfinite(array).all():
        index = int(np.isfinite(array).all(axis=1).argmin())
        raise InvalidInputError(f"point {index} is not finite: {array[index]}")
    if np.abs(array).max(initial=0.0) > MAX_POSITION_M:
        index = int((np.abs(array) > MAX_POSITION_M).any(axis=1).argmax())
        raise InvalidInputError(
            f"point {index} is {array[index]}, more than {MAX_POSITION_M:g} m from 0 0 0; "
            "are these metres of the map frame?"
        )
    return array


def scan_points(points: ArrayLike, *, least: int = 1) -> Floats:
    """Return points [N, 3] of a scan as float32; points that are not finite may be among them.

    Columns after the third, such as intensities and colours, are left out.
    """
    array = _points(points, np.float32, InvalidScanError, columns=_MAX_COLUMNS)
    if len(array) < least:
        raise InvalidScanError("the scan has no points")
    return array


def open_directions(vectors: ArrayLike) -> Floats:
    """Return unit vectors [M, 3] along the rays of a scan that met nothing, as float32."""
    array = _points(vectors, np.float64, InvalidScanError, what="no_return")
    longest = np.abs(array).max(axis=1, keepdims=True)
    good = np.isfinite(longest[:, 0]) & (longest[:, 0] > 0)
    if not good.all():
        index = int(good.argmin())
        raise InvalidScanError(
            f"direction {index} of no_return is {array[index]}: a direction is finite and has a "
            "length; leave out rays of which nothing is known"
        )
    # Scaled first: the square of a very long or short vector has no place in a double.
    scaled = array / longest
    unit: Floats = (scaled / np.linalg.norm(scaled, axis=1, keepdims=True)).astype(np.float32)
    return unit


def stamp_ns(stamp_s: float) -> int:
    """Return a stamp in seconds since 1970 as nanoseconds."""
    try:
        seconds = real_number(stamp_s)
    except NO_NUMBER:
        seconds = math.nan
    if not 0 <= seconds < 2**63 / 1e9:
        finer = ": are these milliseconds, or nanoseconds?" if 0 < seconds < math.inf else ""
        raise InvalidScanError(
            f"stamp_s = {shown(stamp_s)} is not a time in seconds since 1970{finer}"
        )
    return round(seconds * 1e9)


def deadline(timeout_s: float) -> float:
    """Return when ``timeout_s`` from now is over, on the monotonic clock; it may be infinite."""
    return time.monotonic() + within("timeout_s", timeout_s, math.inf, least=-math.inf)


def chosen_epoch(at_epoch: int | None, name: str = "at_epoch") -> int:
    """Return the number of an epoch as it is sent: 0 is the newest. ``name`` is the argument's."""
    if at_epoch is None:
        return 0
    try:
        number = whole_number(at_epoch)
    except TypeError as error:
        raise InvalidInputError(
            f"{name} = {shown(at_epoch)} is not the number of an epoch"
        ) from error
    if not 0 < number < 2**63:
        raise InvalidInputError(f"{name} = {shown(at_epoch)}: epochs are numbered from 1 on")
    return number


def box(bounds: Bounds | None) -> tuple[Doubles, Doubles]:
    """Return the corners [3] of ``bounds``; ``None`` is everywhere."""
    if bounds is None:
        return np.full(3, -np.inf), np.full(3, np.inf)
    try:
        minimum, maximum = (real_numbers(corner).astype(np.float64) for corner in bounds)
    except NO_NUMBER as error:
        raise InvalidInputError(f"bounds = {shown(bounds)}: give (minimum, maximum)") from error
    if minimum.shape != (3,) or maximum.shape != (3,):
        raise InvalidInputError(f"bounds = {bounds!r}: each corner has three coordinates")
    if not (minimum <= maximum).all():
        raise InvalidInputError(f"bounds = {bounds!r}: the minimum must not exceed the maximum")
    return minimum, maximum


def flag(name: str, value: bool) -> bool:
    """Return ``value`` where it is a truth value, also one of numpy's."""
    if not isinstance(value, bool | np.bool_):
        raise InvalidInputError(f"{name} = {shown(value)}: use True or False")
    return bool(value)


def count(name: str, value: int, most: int, *, least: int = 0) -> int:
    """Return ``value`` where it is a number of things, from ``least`` to ``most``."""
    try:
        number = whole_number(value)
    except TypeError as error:
        raise InvalidInputError(f"{name} = {shown(value)} is not a whole number") from error
    if not least <= number <= most:
        raise InvalidInputError(f"{name} = {shown(value)}: use {least} to {most}")
    return number


def are_local(coordinates: str) -> bool:
    """Return whether ``coordinates`` are those that count from the map's origin."""
    if coordinates not in ("map", "local"):
        raise InvalidInputError(f"coordinates = {coordinates!r}: use 'map' or 'local'")
    return coordinates == "local"


def level_of_detail(level: int) -> int:
    """Return ``level`` where the mesh has such a level of detail."""
    return count("level", level, LEVELS - 1)


def finite_box(bounds: Bounds) -> tuple[Doubles, Doubles]:
    """Return the corners [3] of ``bounds``, infinite sides at ``MAX_POSITION_M``."""
    minimum, maximum = (np.clip(corner, -MAX_POSITION_M, MAX_POSITION_M) for corner in box(bounds))
    if not (minimum < maximum).all():
        raise InvalidInputError(
            f"bounds = {bounds!r} hold nothing: each side needs a length, within "
            f"{MAX_POSITION_M:g} m from 0 0 0"
        )
    return minimum, maximum


def grid_shape(bounds: Bounds, cell_m: float) -> GridShape:
    """Return the grid of cells that fill ``bounds``; a flat box lies in the middle of one layer."""
    side_m = within("cell_m", cell_m)
    low, high = box(bounds)
    if not np.isfinite([low, high]).all():
        raise InvalidInputError(f"bounds = {bounds!r}: a grid needs finite ones")
    counts = np.maximum(np.ceil((high - low) / side_m - 1e-6), 1.0)
    if counts.prod() > _MAX_CELLS:
        raise InvalidInputError(
            f"{counts.prod():.3g} cells of {side_m:g} m in {bounds!r}: "
            f"ask for at most {_MAX_CELLS:g}"
        )
    corner = np.where(high > low, low, low - side_m / 2)
    return GridShape(corner, side_m, (int(counts[0]), int(counts[1]), int(counts[2])))


def within(
    name: str, value: float, most: float = MAX_DISTANCE_M, *, least: float = MIN_LENGTH_M
) -> float:
    """Return a number from ``least`` to ``most``."""
    try:
        number = real_number(value)
    except NO_NUMBER as error:
        raise InvalidInputError(f"{name} = {shown(value)} is not a number") from error
    if not least <= number <= most:
        raise InvalidInputError(f"{name} = {shown(value)}: use {least:g} to {most:g}")
    return number


def radii(values: ArrayLike, count: int) -> Floats:
    """Return radii [count], from as many or a single one."""
    try:
        array = np.broadcast_to(real_numbers(values).astype(np.float32), (count,))
    except NO_NUMBER as error:
        raise InvalidInputError(f"radii_m are not one number or {count}: {error}") from error
    bad = ~((array >= 0) & (array <= MAX_DISTANCE_M))
    if bad.any():
        index = int(bad.argmax())
        raise InvalidInputError(
            f"radius {index} is {array[index]}: use 0 to {MAX_DISTANCE_M:g}, in metres"
        )
    return array


def directions(vectors: ArrayLike) -> Doubles:
    """Return unit vectors [N, 3] along ``vectors``."""
    array = query_points(vectors)
    lengths = np.linalg.norm(array, axis=1)
    if not (lengths > 0).all():
        index = int((lengths <= 0).argmax())
        raise InvalidInputError(f"direction {index} is {array[index]}: it has no length")
    return np.asarray(array / lengths[:, None], np.float64)


def ray_origins(origins: ArrayLike, count: int) -> Doubles:
    """Return origins [count, 3], from as many or a single one."""
    try:
        is_one = np.shape(origins) == (3,)
    except ValueError:  # rows of different lengths, which are refused below
        is_one = False
    places = query_points(np.asarray(origins)[None] if is_one else origins)
    if len(places) not in (1, count):
        raise InvalidInputError(f"{len(places)} origins for {count} directions: one, or as many")
    return np.broadcast_to(places, (count, 3))


def _points(
    points: ArrayLike,
    dtype: Any,
    error: type[InvalidInputError],
    *,
    what: str = "points",
    columns: int = 3,
) -> NDArray[Any]:
    """Return the first three of up to ``columns`` columns."""
    try:
        array = real_numbers(points)
    except NO_NUMBER as cause:
        raise error(f"{what} are not an array [N, 3] of real numbers: {cause}") from cause
    if array.size == 0 and array.ndim == 1:
        array = array.reshape(0, 3)
    if array.ndim != 2 or not 3 <= array.shape[1] <= columns:
        hint = {1: "; a single one is [[x, y, z]]", 2: "; is it transposed?"}.get(array.ndim, "")
        hint = hint if array.shape[:1] == (3,) else ""
        raise error(f"{what} are {list(array.shape)}, not [N, 3]{hint}")
    return array[:, :3].astype(dtype, copy=False)


def shown(value: Any) -> str:
    """Return ``value`` for a text, cut short; Python writes no integers of thousands of digits."""
    try:
        return reprlib.repr(value)
    except ValueError:
        return f"an integer of {value.bit_length()} bits"
