"""Places of a region: cubes of some metres, for each of which is told how well it was learnt."""

import numpy as np
from triquad_format.records.arrays import Doubles, Floats, Longs
from triquad_format.records.field_settings import FieldSettings

from triquad_server.mapping.ray_table import END

_PLACE_LEAVES = 32.0  # side of a place
_AXIS_BITS = 20


def place_keys(rows: Floats, settings: FieldSettings) -> Longs:
    """The place [N] in which each ray ends, given by the ``rows`` [N, COLUMNS] of their table."""
    side_m = _PLACE_LEAVES * settings.leaf_m
    cells = np.floor(rows[:, END : END + 3] / side_m).astype(np.int64) + (1 << (_AXIS_BITS - 1))
    keys: Longs = cells[:, 0] << 2 * _AXIS_BITS | cells[:, 1] << _AXIS_BITS | cells[:, 2]
    return keys


def place_centres(keys: Longs, settings: FieldSettings) -> Doubles:
    """The centres [P, 3] of places, metres from the region's centre."""
    shifts = np.array([2 * _AXIS_BITS, _AXIS_BITS, 0])
    cells = (keys[:, None] >> shifts & (1 << _AXIS_BITS) - 1) - (1 << (_AXIS_BITS - 1))
    centres: Doubles = (cells + 0.5) * (_PLACE_LEAVES * settings.leaf_m)
    return centres
