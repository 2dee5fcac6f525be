"""2-D Morton codes of tensors, and in kernels: those of :mod:`triquad_format.records.morton`."""

from typing import Any, TypeVar

from numba.extending import register_jitable

_SPREAD = (
    (16, 0x0000FFFF0000FFFF),
    (8, 0x00FF00FF00FF00FF),
    (4, 0x0F0F0F0F0F0F0F0F),
    (2, 0x3333333333333333),
    (1, 0x5555555555555555),
)

CoordinateT = TypeVar("CoordinateT")


@register_jitable
def encode(first: CoordinateT, second: CoordinateT) -> CoordinateT:
    """Morton codes of non-negative int64 coordinates below 2**31: numbers or tensors."""
    codes: CoordinateT = _spread(first) | (_spread(second) << 1)
    return codes


@register_jitable
def _spread(bits: Any) -> Any:
    for shift, mask in _SPREAD:
        bits = (bits | (bits << shift)) & mask
    return bits
