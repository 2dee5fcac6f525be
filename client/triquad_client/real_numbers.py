"""Numbers that callers give; text such as ``"1.5"`` is none, though Python and numpy convert it."""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def real_numbers(values: ArrayLike) -> NDArray[Any]:
    """Return an array of whole or floating numbers, or raise one of :data:`NO_NUMBER`."""
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
    if isinstance(value, str | bytes):
        raise TypeError("text")
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf
