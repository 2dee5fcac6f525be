"""Boxes that requests name, in the map frame."""

import numpy as np
from triquad_format.errors import RefusedError
from triquad_format.records.arrays import Doubles


def check_box(minimum: Doubles, maximum: Doubles) -> None:
    """Refuse a box [3], [3] with NaN or with corners the wrong way round; infinite is allowed.

    Raises:
        RefusedError: it is such a box.
    """
    if np.isnan([minimum, maximum]).any() or (minimum > maximum).any():
        raise RefusedError("bad_request", f"not a box: minimum {minimum}, maximum {maximum}")
