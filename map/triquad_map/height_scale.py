"""Colours of heights, the same in all that shows a map: pictures, viewers, previews in map files.

They are the upper three quarters of viridis, from blue below to yellow above: steps of the same
height appear the same, also to those who see no red or no green, and the darkest is bright enough
to be shaded.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles

HEIGHT_STOPS: Doubles = np.array(
    [
        [0.230, 0.322, 0.546],
        [0.186, 0.419, 0.557],
        [0.149, 0.508, 0.557],
        [0.121, 0.596, 0.544],
        [0.158, 0.684, 0.502],
        [0.304, 0.765, 0.420],
        [0.516, 0.831, 0.294],
        [0.762, 0.876, 0.137],
        [0.993, 0.906, 0.144],
    ]
)
"""``[9, 3]`` sRGB in [0, 1], evenly spaced from the bottom of a scale to its top."""

GAMMA = 2.2
"""The power of colours that takes sRGB to linear light, near enough."""

_MOST = (0.01, 0.99)  # a treetop or a hole does not take the colours from all else
_LEAST_RANGE_M = 0.1  # noise on a floor is no relief


@dataclass(frozen=True)
class HeightScale:
    """Colours for heights from ``low_m`` to ``high_m``; what lies beyond has those of its ends."""

    low_m: float
    high_m: float

    @classmethod
    def around(cls, heights_m: NDArray[np.floating]) -> "HeightScale":
        """Return the scale for 98 % of heights ``[N]``, at least 0.1 m of them."""
        if not len(heights_m):
            return cls(0.0, _LEAST_RANGE_M)
        low, high = (float(end) for end in np.quantile(heights_m, _MOST))
        short = max(_LEAST_RANGE_M - (high - low), 0.0)
        return cls(low - short / 2, high + short / 2)

    def colours(self, heights_m: NDArray[np.floating]) -> Doubles:
        """Return colours ``[N, 3]``, sRGB in [0, 1], of heights ``[N]``."""
        place = (np.asarray(heights_m, np.float64) - self.low_m) / (self.high_m - self.low_m)
        return colours_between(HEIGHT_STOPS, place)


def colours_between(stops: Doubles, places: Doubles) -> Doubles:
    """Return colours ``[N, 3]`` of places ``[N]`` from 0 to 1 along even ``stops`` ``[S, 3]``.

    What lies beyond has the colours of the ends.
    """
    at = np.linspace(0.0, 1.0, len(stops))
    return np.stack([np.interp(places, at, channel) for channel in stops.T], axis=1)
