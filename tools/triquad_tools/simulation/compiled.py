"""The one way in which this package compiles its kernels."""

from collections.abc import Callable
from typing import TypeVar, cast

import numba

FunctionT = TypeVar("FunctionT", bound=Callable[..., object])


def compiled(function: FunctionT) -> FunctionT:
    """``function`` compiled by numba: cached on disk, and running without the GIL.

    The cache follows changes of the file that holds ``function`` alone: after changing a kernel
    that kernels of another file call, delete ``__pycache__``.
    """
    return cast(FunctionT, numba.njit(cache=True, nogil=True)(function))
