"""The memory of the numbers of a field: arrays of this process, or tensors on a device."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

Array = NDArray[Any]

Rows = Any
"""Numbers as a memory holds them: an array, or a tensor, which has the same arithmetic."""

_LINE_BYTES = 64
"""The line size of the processor's cache. A row of eight numbers is half a line, and lies in one
if arrays begin with a line; numpy's own begin 16 bytes after one."""


class FieldNumbers(NamedTuple):
    """The numbers of a field, all in one memory."""

    features: Rows  # [rows, d] by the rows of the tree; row 0, of absent vertices, is zero
    mlp: tuple[Rows, ...]  # weights [in, out] and bias [out] of each layer in turn
    frequencies: Rows  # [m] of Fourier features, on coordinates normalised to [-1, 1]


class Memory:
    """Makes and copies what the numbers of fields are in: arrays, which compiled code trains."""

    device = "cpu"  # or another device of torch

    def put(self, array: Array) -> Rows:
        """Return a copy of an array."""
        copied = _empty(array.shape, array.dtype)
        copied[...] = array
        return copied

    def room(self, count: int, like: Rows) -> Rows:
        """Return ``count`` rows shaped as those of ``like``, not initialised."""
        return _empty((count, *like.shape[1:]), like.dtype)

    def array(self, rows: Rows) -> Array:
        """Return rows as an array, which may share memory with them."""
        array: Array = rows
        return array


def memory_on(device: str) -> Memory:
    """Return the memory of the fields that are trained on a device, ``cpu`` or another of torch."""
    if device == "cpu":
        return Memory()
    from triquad_server.engine.tensor_field import TensorMemory  # its import takes 200 MB

    return TensorMemory(device)


def _empty(shape: tuple[int, ...], dtype: DTypeLike) -> Array:
    """Return an array that is not initialised; it begins with a line of the cache."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    # The system reserves no memory before it is written to.
    memory = np.empty(size + _LINE_BYTES, np.uint8)
    start = -memory.ctypes.data % _LINE_BYTES
    return memory[start : start + size].view(dtype).reshape(shape)
