"""Sums the gradients of the features of fields, by each thread that trains."""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Floats, Ints
from triquad_map.compiled.team import THREADS

_LAST_STEP = 2**31 - 1


class Touched(NamedTuple):
    """The feature rows that a thread has added a gradient to."""

    stamps: Ints  # [rows] the step in which each row was touched last
    rows: Ints  # [rows] those touched in this step, in order


class GradientSums:
    """Buffers for the gradients of feature rows, for each thread; all but row 0 are zero between
    steps.

    Trainers that do not train at the same time share it.
    """

    def __init__(self) -> None:
        self.features: tuple[Floats, ...] = ()  # per thread [rows, size]
        self.touched: tuple[Touched, ...] = ()  # per thread
        self.step = 0

    def begin(self, rows: int, size: int) -> None:
        """Make room for a step with ``rows`` of ``size`` numbers."""
        self.step += 1
        known = self.features[0].shape if self.features else (0, 0)
        if known[0] < rows or known[1] != size or self.step == _LAST_STEP:
            room = rows + rows // 4
            self.clear()
            self.touched = tuple(
                Touched(np.zeros(room, np.int32), np.zeros(room, np.int32)) for _ in range(THREADS)
            )
            self.features = tuple(np.zeros((room, size), np.float32) for _ in range(THREADS))

    def clear(self) -> None:
        """Free the buffers."""
        self.features, self.touched, self.step = (), (), 1
