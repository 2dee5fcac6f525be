"""Colours for numbers. They differ in lightness, so that everyone can tell them apart."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import ImageColor

WHITE = "#ffffff"

HEIGHT = ("#440154", "#414487", "#2a788e", "#22a884", "#7ad151", "#fde725")
"""Viridis, dark to light."""

HEAT = ("#dfe3e8", "#f3cf8a", "#e8944a", "#c14a2e", "#6e1423", "#2b0912")
"""Light to dark: what is small keeps in the background."""

AGE = ("#e6ecf2", "#bcd3e8", "#86b3d9", "#4a8fc4", "#1f6cab")
"""Light to dark blue: what is recent stands out."""


@dataclass(frozen=True)
class ColourScale:
    """Colours for values between two limits."""

    label: str
    stops: tuple[str, ...]  # evenly spaced from low to high, as #rrggbb
    low: float
    high: float

    def colours(self, values: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Colours ``[..., 3]`` of values ``[...]``, white where a value is NaN.

        What is beyond a limit gets the limit's colour.
        """
        place = (values - self.low) / max(self.high - self.low, 1e-9)
        stops = np.array([rgb(stop) for stop in self.stops])
        at = np.linspace(0.0, 1.0, len(stops))
        mixed = [np.interp(place, at, channel) for channel in stops.T]
        colours = np.nan_to_num(np.stack(mixed, axis=-1), nan=255.0)
        return np.asarray(colours.round(), np.uint8)


def rgb(colour: str) -> tuple[int, ...]:
    """Red, green and blue, 0 to 255, of ``#rrggbb``."""
    return ImageColor.getrgb(colour)[:3]
