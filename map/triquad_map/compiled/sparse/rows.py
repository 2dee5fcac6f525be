"""Arrays to which rows are added."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def with_room(rows: NDArray[Any], capacity: int) -> NDArray[Any]:
    """A copy of ``rows`` [N, ...] with room for ``capacity`` of them; the new ones are zero."""
    roomy = np.zeros((capacity, *rows.shape[1:]), rows.dtype)
    roomy[: len(rows)] = rows
    return roomy
