"""Messages of ROS 2 as CDR, little-endian: written from arrays, and those read again.

Libraries do that too, but with objects: large messages take seconds.
"""

from typing import Any

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


class CdrReader:
    """The fields of a message, in the order of its definition."""

    def __init__(self, payload: bytes) -> None:
        """Begin with the first field.

        Raises:
            ValueError: it is no plain little-endian CDR.
        """
        if payload[:4] != _LITTLE_ENDIAN:
            raise ValueError(f"no plain little-endian CDR: {payload[:4].hex()}")
        self._data = memoryview(payload)[4:]
        self._at = 0

    def numbers(self, dtype: str, count: int = 1) -> NDArray[Any]:
        """Read numbers [count] of one type, such as ``<f8``.

        Raises:
            ValueError: the message ends before.
        """
        self._at += -self._at % np.dtype(dtype).itemsize
        values = np.frombuffer(self._data, dtype, count, self._at)
        self._at += values.nbytes
        return values

    def text(self) -> str:
        """Read a string.

        Raises:
            ValueError: the message ends before, or it is no text.
        """
        return self.numbers("u1", int(self.numbers("<u4")[0])).tobytes()[:-1].decode()
