"""A surface as triangles."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools


@dataclass(frozen=True)
class Triangles:
    """Triangles of the map frame."""

    vertices: NDArray[np.float64]  # [V, 3] metres
    faces: NDArray[np.int32]  # [F, 3] counter-clockwise seen from free space
    # [F] whether no ray has met the surface there: it is continued from what was seen, and the
    # status there is UNKNOWN; None where no holes were to be filled
    filled: Bools | None = None
