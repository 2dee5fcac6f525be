"""Arrays as they travel: dtype, shape and raw little-endian bytes, checked before use."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from triquad_format.errors import WireError

DTYPES = frozenset(
    {"|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f2", "<f4", "<f8"},
)
MAX_DIMENSIONS = 4


@dataclass(frozen=True)
class ArraySpec:
    """What a field of a message accepts: one dtype, and sizes per axis (``None``: any)."""

    dtype: str
    shape: tuple[int | None, ...]

    def check(self, name: str, array: NDArray[np.generic]) -> None:
        """Raise :class:`WireError` naming ``name`` where ``array`` does not fit."""
        fits = array.ndim == len(self.shape) and all(
            want is None or want == have for want, have in zip(self.shape, array.shape, strict=True)
        )
        if array.dtype.str != self.dtype or not fits:
            shape = ", ".join("N" if size is None else str(size) for size in self.shape)
            raise WireError(
                f"{name}: expected an array [{shape}] of {self.dtype}, "
                f"got {list(array.shape)} of {array.dtype.str}",
            )


def pack_array(array: NDArray[np.generic]) -> dict[str, object]:
    """The msgpack form of an array, little endian and C order."""
    little = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<"), copy=False)
    if little.dtype.str not in DTYPES:
        raise WireError(f"arrays of {array.dtype} do not travel; use one of {sorted(DTYPES)}")
    return {
        "dtype": little.dtype.str,
        "shape": list(array.shape),
        "data": little.tobytes(),
    }


def unpack_array(name: str, packed: object) -> NDArray[np.generic]:
    """The array of a msgpack form; read-only, sharing the message's bytes.

    Raises:
        WireError: the form is not complete or its sizes contradict each other. Nothing is
            allocated for a shape that the bytes do not fill.
    """
    if not isinstance(packed, Mapping) or set(packed) != {"dtype", "shape", "data"}:
        raise WireError(f"{name}: expected an array with dtype, shape and data")
    dtype, shape, data = packed["dtype"], packed["shape"], packed["data"]
    if not isinstance(dtype, str) or dtype not in DTYPES:
        raise WireError(f"{name}: dtype {dtype!r} is not one of {sorted(DTYPES)}")
    if not isinstance(shape, list) or len(shape) > MAX_DIMENSIONS:
        raise WireError(f"{name}: shape {shape!r} is not a list of at most {MAX_DIMENSIONS} sizes")
    # Sizes beside a zero count too: numpy does not form shapes beyond 64 bits, however empty.
    counts = all(type(size) is int and 0 <= size < 2**40 for size in shape)
    if not counts or math.prod(size or 1 for size in shape) >= 2**40:
        raise WireError(f"{name}: shape {shape!r} has a size that is not a count")
    if not isinstance(data, bytes) or math.prod(shape) * np.dtype(dtype).itemsize != len(data):
        raise WireError(f"{name}: shape {shape!r} of {dtype} does not fill its data")
    return np.frombuffer(data, dtype).reshape(shape)
