"""Colours of distances, and what they mean."""

import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Bytes

from triquad_tools.plots.plan import UNKNOWN
from triquad_tools.plots.slice_plan import DISTANCE_COLOURS
from triquad_tools.viewer.page.colour_scale import ColourScale, Stops

_STOPS: Stops = tuple(to_rgb(DISTANCE_COLOURS(place)) for place in np.linspace(0.0, 1.0, 17))


def distance_scale(label: str, max_distance_m: float) -> ColourScale:
    """From 0 to the largest distance, which stands for all beyond, too."""
    return ColourScale(label, 0.0, max_distance_m, open_above=True, stops=_STOPS)


def distance_colours(
    distance_m: NDArray[np.floating], known: Bools, max_distance_m: float
) -> Bytes:
    """Colours [..., 3] of distances [...]; grey where nothing is known, whatever the distance."""
    colours = DISTANCE_COLOURS(np.asarray(distance_m, np.float64) / max_distance_m)[..., :3]
    colours[~known] = to_rgb(UNKNOWN)
    return np.asarray(np.round(255.0 * colours), np.uint8)
