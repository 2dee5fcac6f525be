"""msgpack, and the arrays in it, as messages and parts of map files have them.

What others sent takes little memory if it is small, and all of it little time: a few megabytes can
contain millions of tiny objects, which would take a hundred times their size and block everything
else for seconds.
"""

import math
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from triquad_format.errors import WireError

MAX_OBJECTS = 20_000
_MAX_DEPTH = 16
_MAX_STRING_BYTES = 65_536
# Room for a list is taken before its items are seen, and 1024 may be within each other.
_MAX_LIST_ITEMS = 64
_MAX_MAP_ITEMS = 4096

_ITEM_BYTES = {
    name: np.dtype(name).itemsize
    for name in ("|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f2", "<f4", "<f8")
}
"""The dtypes of arrays that travel, and how many bytes an item of each has."""

_ARRAY_KEYS = {"dtype", "shape", "data"}
_MAX_DIMENSIONS = 4
_MAX_SIZE = 2**40  # of an array along one axis, and of all axes together


@dataclass(frozen=True)
class ArraySpec:
    """The arrays that a message's field accepts: one dtype, and sizes per axis (``None``: any)."""

    dtype: str
    shape: tuple[int | None, ...]

    def check(self, name: str, array: NDArray[np.generic]) -> None:
        """Raise :class:`WireError` naming ``name`` where ``array`` does not fit."""
        if array.dtype.str != self.dtype or not self._fits(array.shape):
            shape = ", ".join("N" if size is None else str(size) for size in self.shape)
            raise WireError(
                f"{name}: expected an array [{shape}] of {self.dtype}, "
                f"got {list(array.shape)} of {array.dtype.str}"
            )

    def _fits(self, shape: tuple[int, ...]) -> bool:
        # Not by all(): every message comes by here, and a generator takes longer than the rest.
        for want, have in zip(self.shape, shape, strict=False):
            if want is not None and want != have:
                return False
        return len(shape) == len(self.shape)


def unpacked(payload: bytes) -> object:
    """Return the object that a payload is.

    Raises:
        WireError: it is no whole msgpack object, has one of an extension type, is too deep, or made
            of too many objects.
    """
    left = MAX_OBJECTS

    def counted(items: list[Any]) -> list[Any]:
        nonlocal left
        left -= len(items)
        if left < 0:
            raise WireError(f"more than {MAX_OBJECTS} objects")
        return items

    try:
        value = msgpack.unpackb(
            payload,
            list_hook=counted,
            object_pairs_hook=lambda pairs: dict(counted(pairs)),
            max_str_len=_MAX_STRING_BYTES,
            max_array_len=_MAX_LIST_ITEMS,
            max_map_len=_MAX_MAP_ITEMS,
            max_ext_len=0,
        )
    except (ValueError, TypeError, msgpack.exceptions.UnpackException) as error:
        raise WireError(f"not msgpack: {error or type(error).__name__}") from error
    if not _is_shallow(value, _MAX_DEPTH):
        raise WireError(f"nested more than {_MAX_DEPTH} deep")
    return value


def _is_shallow(value: object, levels: int) -> bool:
    """Return whether an object has at most ``levels`` of lists and maps within each other."""
    if not isinstance(value, (dict, list)):
        return True
    items = value.values() if isinstance(value, dict) else value
    return levels > 0 and all(_is_shallow(item, levels - 1) for item in items)


def pack_array(array: NDArray[np.generic]) -> dict[str, object]:
    """Return the msgpack form of an array, little endian and C order."""
    dtype = array.dtype.str
    if dtype not in _ITEM_BYTES:
        array = array.astype(array.dtype.newbyteorder("<"))
        dtype = array.dtype.str
        if dtype not in _ITEM_BYTES:
            names = sorted(_ITEM_BYTES)
            raise WireError(f"arrays of {array.dtype} do not travel; use one of {names}")
    return {"dtype": dtype, "shape": list(array.shape), "data": array.tobytes()}


def unpack_array(name: str, packed: object) -> NDArray[np.generic]:
    """Return the array of a msgpack form; read-only, sharing the message's bytes.

    Raises:
        WireError: the form is not complete or its sizes contradict each other. Nothing is
            allocated for a shape that the bytes do not fill.
    """
    if not isinstance(packed, dict) or packed.keys() != _ARRAY_KEYS:
        raise WireError(f"{name}: expected an array with dtype, shape and data")
    dtype, shape, data = packed["dtype"], packed["shape"], packed["data"]
    if not isinstance(dtype, str) or dtype not in _ITEM_BYTES:
        raise WireError(f"{name}: dtype {dtype!r} is not one of {sorted(_ITEM_BYTES)}")
    if not isinstance(shape, list) or len(shape) > _MAX_DIMENSIONS:
        raise WireError(f"{name}: shape {shape!r} is not a list of at most {_MAX_DIMENSIONS} sizes")
    items = 1  # but for sizes of zero: numpy does not form shapes beyond 64 bits, however empty
    for size in shape:
        if type(size) is not int or not 0 <= size < _MAX_SIZE:
            raise WireError(f"{name}: shape {shape!r} has a size that is not a count")
        items *= size or 1
    if items >= _MAX_SIZE:
        raise WireError(f"{name}: shape {shape!r} has a size that is not a count")
    if not isinstance(data, bytes) or math.prod(shape) * _ITEM_BYTES[dtype] != len(data):
        raise WireError(f"{name}: shape {shape!r} of {dtype} does not fill its data")
    return np.frombuffer(data, dtype).reshape(shape)
