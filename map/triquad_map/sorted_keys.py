"""Keys in increasing order, and where others are among them."""

import numpy as np
from triquad_format.records.arrays import Longs


def rows_of(keys: Longs, wanted: Longs) -> Longs:
    """Return rows [N] of ``wanted`` [N] in increasing ``keys`` [K]; -1 for what is not there."""
    if len(keys) == 0:
        return np.full(len(wanted), -1, np.int64)
    rows = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.where(keys[rows] == wanted, rows, -1)
