"""What hypothesis draws for the mutants of map files: where to change them, and to what."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar

from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

MAX_BOMB_BYTES = 24 * 2**20
NUMBERS = (0, 1, 2, 255, 2**16, 2**31, 2**32 - 1, 2**40, 2**62, 2**63 - 1, 2**63, 2**64 - 1)

T = TypeVar("T")


class Draw(Protocol):
    """Draws a value, as the ``draw`` of hypothesis's ``st.data()`` does."""

    def __call__(self, strategy: SearchStrategy[T]) -> T: ...


Mutation = Callable[[Draw, bytes], bytes]


def chance(draw: Draw, percent: int) -> bool:
    return draw(st.integers(0, 99)) < percent


def place(draw: Draw, items: Sequence[object]) -> int:
    return draw(st.integers(0, len(items) - 1))


def number(draw: Draw) -> int:
    return draw(st.sampled_from(NUMBERS))


def bomb_bytes(draw: Draw) -> int:
    return int(MAX_BOMB_BYTES * draw(st.floats(0, 1)) ** 2)


def shuffle(draw: Draw, items: list[Any]) -> None:
    """Remove, double, swap or overwrite an item."""
    a, b = place(draw, items), place(draw, items)
    how = draw(st.sampled_from(["remove", "double", "swap", "overwrite"]))
    if how == "remove" and len(items) > 1:
        del items[a]
    elif how == "double":
        items.insert(b, items[a])
    elif how == "swap":
        items[a], items[b] = items[b], items[a]
    else:
        items[a] = items[b]


def flipped(draw: Draw, data: bytes, most: int) -> bytes:
    out = bytearray(data)
    for bit in draw(st.lists(st.integers(0, 8 * len(data) - 1), min_size=1, max_size=most)):
        out[bit // 8] ^= 1 << bit % 8
    return bytes(out)
