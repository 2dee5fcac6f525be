"""Messages of ROS 2 written as CDR, little-endian, from arrays.

Libraries write messages too, but from objects: large ones take seconds.
"""

import numpy as np
from numpy.typing import NDArray

_LITTLE_ENDIAN = b"\x00\x01\x00\x00"  # plain CDR


class CdrWriter:
    """Fields in the order of the message's definition (OMG formal/02-06-51, chapter 15)."""

    def __init__(self) -> None:
        self._data = bytearray()

    def numbers(self, dtype: str, *values: float) -> "CdrWriter":
        """Write numbers of one type, such as ``<f8``."""
        return self._array(np.array(values, dtype))

    def text(self, value: str) -> "CdrWriter":
        """Write a string."""
        data = value.encode() + b"\x00"
        self.numbers("<u4", len(data))
        self._data += data
        return self

    def sequence(self, values: NDArray[np.generic]) -> "CdrWriter":
        """Write elements [N, ...] of one or more numbers each."""
        self.numbers("<u4", len(values))
        return self._array(values) if len(values) else self

    def payload(self) -> bytes:
        """Return the bytes of the message."""
        return _LITTLE_ENDIAN + bytes(self._data)

    def _array(self, values: NDArray[np.generic]) -> "CdrWriter":
        self._data += bytes(-len(self._data) % values.itemsize)
        self._data += values.tobytes()
        return self
