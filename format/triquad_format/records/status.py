"""The status of a queried point, by the evidence."""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Status(IntEnum):
    """Status of a point; the values travel on the wire as ``uint8``."""

    UNKNOWN = 0
    """No ray has shown anything here: the distance is not to be trusted."""

    FREE = 1
    """Rays have passed through here."""

    SURFACE = 2
    """Within half a voxel of one in which a ray ended: there the distance is trained."""


class Statuses(np.ndarray):
    """An array of ``uint8`` whose values are told as those of :class:`Status`, by their names."""

    @classmethod
    def of(cls, values: NDArray[np.uint8]) -> Statuses:
        """Return the same numbers, to be told by name."""
        return values.view(cls)

    def counted(self) -> str:
        """Return how many there are of each status, such as ``812 FREE, 148 UNKNOWN``."""
        numbers = np.bincount(self.ravel(), minlength=len(Status))
        found = [f"{numbers[status]} {status.name}" for status in _IN_ORDER if numbers[status]]
        return ", ".join(found)

    def __repr__(self) -> str:
        return f"Statuses({self})"

    def __str__(self) -> str:
        names = np.array([status.name for status in Status])[self.view(np.ndarray)]
        return np.array2string(names, separator=", ", formatter={"all": str})

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        """Return what numpy made of statuses, which are none any more, as it is."""
        return array[()] if return_scalar else array.view(np.ndarray)


_IN_ORDER = (Status.FREE, Status.SURFACE, Status.UNKNOWN)
