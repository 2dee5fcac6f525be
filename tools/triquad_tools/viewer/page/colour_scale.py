"""Scales of colours."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles
from triquad_map.height_scale import GAMMA, HEIGHT_STOPS, colours_between

_TICKS = 5

Stops = tuple[tuple[float, float, float], ...]
"""Colours, sRGB in [0, 1], evenly spaced from the lower to the upper end of a scale."""

_HEIGHTS: Stops = tuple((red, green, blue) for red, green, blue in HEIGHT_STOPS.tolist())


@dataclass(frozen=True)
class ColourScale:
    """Colours for values from ``low`` to ``high``; what is beyond has those of the ends."""

    label: str  # with its unit
    low: float
    high: float
    open_below: bool = False  # there may be values below
    open_above: bool = False
    ticks: Sequence[str] = ()  # at equal steps; empty: the values
    stops: Stops = _HEIGHTS

    @property
    def tick_texts(self) -> list[str]:
        """What stands at equal steps from the lower to the upper end."""
        values = np.linspace(self.low, self.high, _TICKS)
        texts = list(self.ticks) or [f"{value:.3g}" for value in values]
        texts[0] = f"≤ {texts[0]}" if self.open_below else texts[0]
        texts[-1] = f"≥ {texts[-1]}" if self.open_above else texts[-1]
        return texts


def scale_colours(scale: ColourScale, values: NDArray[np.floating]) -> Doubles:
    """Linear colours [N, 3] of values [N]."""
    places = (np.asarray(values, np.float64) - scale.low) / (scale.high - scale.low)
    return colours_between(np.array(scale.stops), places) ** GAMMA
