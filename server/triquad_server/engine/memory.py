"""Where the numbers of a field are: in arrays of this process, or in tensors on a device."""

from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import DTypeLike, NDArray
from triquad_format.records.field_settings import FieldSettings
from triquad_map.compiled.field.field import FieldArrays
from triquad_map.compiled.field.frozen_field import FrozenCompiledField
from triquad_map.compiled.field.quadtree import FrozenQuadtree, LiveQuadtree
from triquad_map.composition.region import FieldEngine

Array = NDArray[Any]

Rows = Any
"""Numbers as a memory holds them: an array, or a tensor, which has the same arithmetic."""

_LINE_BYTES = 64
"""A row of eight numbers is half a line of the processor's cache, and lies in one where arrays
begin with a line; numpy's own begin 16 bytes after one."""


class FieldNumbers(NamedTuple):
    """The numbers of a field, all in one memory."""

    features: Rows  # [rows, d] by the rows of the tree; row 0, of absent vertices, is zero
    mlp: tuple[Rows, ...]  # weights [in, out] and bias [out] of each layer in turn
    frequencies: Rows  # [m] of Fourier features, on coordinates normalised to [-1, 1]


class FrozenField(FieldEngine, Protocol):
    """A field that does not change any more. Safe for any thread."""

    @property
    def settings(self) -> FieldSettings:
        """Its shape."""

    @property
    def tree(self) -> LiveQuadtree | FrozenQuadtree:
        """Its vertices."""

    @property
    def arrays(self) -> FieldArrays:
        """Its numbers; they are not to be changed."""


class Memory(Protocol):
    """Makes and copies what the numbers of fields are in, and answers from them."""

    @property
    def device(self) -> str:
        """Where it is: ``cpu``, or another device of torch."""

    def put(self, array: Array) -> Rows:
        """A copy of an array."""

    def room(self, count: int, like: Rows) -> Rows:
        """So many rows as those of ``like``, in which nothing is written yet."""

    def array(self, rows: Rows) -> Array:
        """Rows as an array, which may share memory with them."""

    def field(
        self, settings: FieldSettings, tree: FrozenQuadtree, numbers: FieldNumbers
    ) -> FrozenField:
        """What answers from a field's numbers, with which it shares memory."""


class ArrayMemory:
    """Arrays, which compiled code trains and answers from."""

    device = "cpu"

    def put(self, array: Array) -> Array:
        """A copy of an array."""
        copied = _empty(array.shape, array.dtype)
        copied[...] = array
        return copied

    def room(self, count: int, like: Array) -> Array:
        """So many rows as those of ``like``, in which nothing is written yet."""
        return _empty((count, *like.shape[1:]), like.dtype)

    def array(self, rows: Array) -> Array:
        """The rows themselves."""
        return rows

    def field(
        self, settings: FieldSettings, tree: FrozenQuadtree, numbers: FieldNumbers
    ) -> FrozenField:
        """The compiled field."""
        return FrozenCompiledField(settings, tree, FieldArrays(*numbers))


def memory_on(device: str) -> Memory:
    """The memory of the fields that are trained on a device, ``cpu`` or another of torch's."""
    if device == "cpu":
        return ArrayMemory()
    from triquad_server.engine.tensor_memory import TensorMemory  # 200 MB, for who needs it

    return TensorMemory(device)


def _empty(shape: tuple[int, ...], dtype: DTypeLike) -> Array:
    """An array in which nothing is written yet; it begins with a line of the cache."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    # Memory that nothing has been written to is not taken from the system.
    memory = np.empty(size + _LINE_BYTES, np.uint8)
    start = -memory.ctypes.data % _LINE_BYTES
    return memory[start : start + size].view(dtype).reshape(shape)
