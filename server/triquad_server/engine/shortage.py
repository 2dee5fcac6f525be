"""Shortages of memory, as torch tells of them."""

from collections.abc import Iterator
from contextlib import contextmanager

_OF_A_GPU = "OutOfMemoryError"  # of torch, which is not imported where there is no GPU
_OF_THE_CPU = "can't allocate memory"  # torch has no error of its own for it


@contextmanager
def shortages() -> Iterator[None]:
    """Raise MemoryError where torch meets too little memory; around work, or as a decorator."""
    try:
        yield
    except RuntimeError as error:
        if type(error).__name__ != _OF_A_GPU and _OF_THE_CPU not in str(error):
            raise
        raise MemoryError(str(error)) from error
