"""Numbers that callers give.

Text and truth values are none, though Python and numpy convert them, and masked values are unknown.
"""

import math
import operator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


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
