"""The one way in which this package compiles its kernels."""

from collections.abc import Callable
from typing import TypeVar, cast

import numba

FunctionT = TypeVar("FunctionT", bound=Callable[..., object])


def compiled(function: FunctionT) -> FunctionT:
    """``function`` compiled by numba: cached on disk, and running without the GIL."""
    return cast(FunctionT, numba.njit(cache=True, nogil=True)(function))
