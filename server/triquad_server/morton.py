"""Morton codes of tensors; the same codes as :mod:`triquad_format.morton`."""

from torch import Tensor

_SPREAD = (
    (16, 0x0000FFFF0000FFFF),
    (8, 0x00FF00FF00FF00FF),
    (4, 0x0F0F0F0F0F0F0F0F),
    (2, 0x3333333333333333),
    (1, 0x5555555555555555),
)


def encode(first: Tensor, second: Tensor) -> Tensor:
    """2-D Morton codes of non-negative int64 coordinates below 2**31."""
    return _spread(first) | (_spread(second) << 1)


def _spread(bits: Tensor) -> Tensor:
    for shift, mask in _SPREAD:
        bits = (bits | (bits << shift)) & mask
    return bits
