"""Colours of distances, and what they mean."""

import numpy as np
from matplotlib.colors import to_hex, to_rgb
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Bytes

from triquad_tools.plots.plan import UNKNOWN
from triquad_tools.plots.slice_plan import DISTANCE_COLOURS

_STOPS = np.linspace(0.0, 1.0, 11)
_TICKS = 4  # numbers below a scale, and one more


def distance_colours(
    distance_m: NDArray[np.floating], known: Bools, max_distance_m: float
) -> Bytes:
    """Colours [..., 3] of distances [...]; grey where nothing is known, whatever the distance."""
    colours = DISTANCE_COLOURS(np.asarray(distance_m, np.float64) / max_distance_m)[..., :3]
    colours[~known] = to_rgb(UNKNOWN)
    return np.asarray(np.round(255.0 * colours), np.uint8)


def scale_html(heading: str, max_distance_m: float) -> str:
    """A scale from 0 to the largest distance, which stands for all beyond, too."""
    stops = ", ".join(to_hex(DISTANCE_COLOURS(stop)) for stop in _STOPS)
    numbers = [f"{number:g}" for number in np.linspace(0.0, max_distance_m, _TICKS + 1)]
    numbers[-1] = f"≥ {numbers[-1]} m"
    ticks = "".join(f"<span>{number}</span>" for number in numbers)
    return text_html(
        f"<div>{heading}</div>"
        f'<div style="height: 0.8em; background: linear-gradient(to right, {stops})"></div>'
        f'<div style="display: flex; justify-content: space-between">{ticks}</div>'
    )


def swatch_html(colour: str, meaning: str) -> str:
    """A colour by itself, and its meaning."""
    box = f"width: 1.2em; height: 0.8em; background: {colour}; border: 1px solid #555"
    return text_html(f'<span style="display: inline-block; {box}"></span> {meaning}')


def text_html(content: str) -> str:
    """A line below a scale."""
    return f'<div style="padding: 0.1em 1em; font-size: 0.8em">{content}</div>'
