"""Shortages of memory, as torch tells of them."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

_SAYS = "can't allocate memory"  # torch's allocator of the CPU has no error of its own


@contextmanager
def shortages() -> Iterator[None]:
    """Raise MemoryError where torch meets too little memory; around work, or as a decorator."""
    try:
        yield
    except torch.OutOfMemoryError as error:  # of a GPU
        raise MemoryError(str(error)) from error
    except RuntimeError as error:
        if _SAYS not in str(error):
            raise
        raise MemoryError(str(error)) from error
