"""The memory that parts of the program take."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

Buffers = Mapping[int, int]
"""The bytes of pieces of memory, by start address: arrays that share one count once."""


def buffers_of(part: object) -> dict[int, int]:
    """Return the memory of all arrays and tensors that a part of the program leads to.

    It is an object, or containers of some, which must not change meanwhile; only those of classes
    of this program are searched.
    """
    found: dict[int, int] = {}
    visited: set[int] = set()
    open_parts: list[Any] = [part]
    while open_parts:
        part = open_parts.pop()
        if id(part) in visited:
            continue
        visited.add(id(part))
        if isinstance(part, np.ndarray):
            root = _root(part)
            found[root.ctypes.data] = root.nbytes
        elif hasattr(part, "untyped_storage"):  # a tensor, without need for torch
            storage = part.untyped_storage()
            found[storage.data_ptr()] = storage.nbytes()
        else:
            open_parts.extend(_within(part))
    return found


def _root(array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    while isinstance(array.base, np.ndarray):
        array = array.base
    return array


def _within(part: object) -> Iterable[object]:
    """List the parts of a container or of an object of this program."""
    if isinstance(part, (tuple, list)):
        return part
    if isinstance(part, dict):
        return list(part.values())
    if type(part).__module__.startswith("triquad_"):
        return list(getattr(part, "__dict__", {}).values())
    return ()
