"""The colours of the mesh, and how to have them unchanged in a browser."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_client.calls.queries import MapQueries
from triquad_client.mesh.followed_mesh import MeshTile
from triquad_format.records.arrays import Doubles
from triquad_map.height_scale import GAMMA, HeightScale

from triquad_tools.plots.colours import HEIGHTS
from triquad_tools.plots.picture import vertex_normals
from triquad_tools.viewer.page.legends import ColourScale

_TOWARDS_SUN = np.array([-0.50, -0.58, 0.64]) / np.linalg.norm([-0.50, -0.58, 0.64])
_SUN, _SKY = 0.55, 0.5
_STEEPER = 2.5  # are slopes in that light than they are: else a kerb on flat ground is not seen
# Of the ends of the scale: it stays the same as the map grows a little.
_STEP_M, _FINE_STEP_M, _FINE_M = 0.5, 0.1, 2.0  # the fine step: of a scale that is as short
_MANY = 0.25  # share of heights within the same half metre
_EVEN_M = 1.0  # about that, the scale is nearly even; farther away it goes by factors
_NEAR_M = 1.0  # around a vertex, where its surface is searched for

# The browser's tone mapping, ACES Filmic as three.js has it, which viser cannot be asked to leave
# out: a fit by Stephen Hill of the ACES reference and output transforms.
_EXPOSURE = 1.0 / 0.6
_IN = np.array([[59719, 35458, 4823], [7600, 90834, 1566], [2840, 13383, 83777]]) / 1e5
_OUT = np.array([[160475, -53108, -7367], [-10208, 110813, -605], [-327, -7276, 107602]]) / 1e5
_FIT = (0.0245786, -0.000090537, 0.983729, 0.4329510, 0.238081)
_BRIGHTEST = 0.98  # of what it lets through: white itself would have to be infinitely bright


@dataclass(frozen=True)
class TileColours:
    """Colours of mesh tiles."""

    scale: ColourScale
    values: Callable[[MeshTile], NDArray[np.floating]]  # [V] places of the vertices on the scale


def height_range(heights_m: NDArray[np.floating]) -> tuple[float, float]:
    """Return round ends, metres, of nearly all heights [N]."""
    around = HeightScale.around(heights_m)
    step_m = _FINE_STEP_M if around.high_m - around.low_m < _FINE_M else _STEP_M
    low_m = math.floor(around.low_m / step_m) * step_m
    return round(low_m, 1), round(math.ceil(around.high_m / step_m) * step_m, 1)


def height_colours(heights_m: NDArray[np.floating]) -> TileColours:
    """Colour by height in the map frame, on a scale for nearly all heights [N].

    Where many lie about one, as on a street with its houses, heights near that have most of the
    colours: on an even scale a car would look like the road.
    """
    ground_m, ends_m = _flat_ground(heights_m), np.array(height_range(heights_m))

    def place(heights_m: NDArray[np.floating]) -> NDArray[np.floating]:
        return heights_m if ground_m is None else np.arcsinh((heights_m - ground_m) / _EVEN_M)

    def height(places: Doubles) -> Doubles:
        return places if ground_m is None else ground_m + _EVEN_M * np.sinh(places)

    low, high = place(ends_m).tolist()
    return TileColours(
        ColourScale("height, m", HEIGHTS, low, high, True, True, told=height),
        values=lambda tile: place(tile.origin[2] + tile.vertices[:, 2]),
    )


def _flat_ground(heights_m: NDArray[np.floating]) -> float | None:
    """Return the height, to half a metre, about which many of heights [N], metres, lie, if any."""
    steps, counts = np.unique(np.round(heights_m / _STEP_M), return_counts=True)
    if not len(steps) or counts.max() < _MANY * len(heights_m):
        return None
    return float(_STEP_M * steps[counts.argmax()])


def confidence_colours(queries: MapQueries) -> TileColours:
    """Colour by how much the rays have shown of the surface: the confidence of distances."""
    return TileColours(
        ColourScale("confidence", HEIGHTS, 0.0, 1.0),
        values=lambda t: queries.query_distance(t.origin + t.vertices, _NEAR_M).confidence,
    )


def lit_colours(colours: TileColours, tile: MeshTile) -> Doubles:
    """Return linear colours [V, 3] for the browser, in the light of a sun and a bright sky."""
    scale = colours.scale
    places = (np.asarray(colours.values(tile), np.float64) - scale.low) / (scale.high - scale.low)
    up = vertex_normals(tile.vertices.astype(np.float64), tile.faces) * [_STEEPER, _STEEPER, 1.0]
    up /= np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-30)
    light = _SUN * np.maximum(up @ _TOWARDS_SUN, 0.0) + _SKY * (0.75 + 0.25 * up[:, 2])
    return before_tone_mapping(scale.colours(places)[:, :3] ** GAMMA * light[:, None])


def before_tone_mapping(shown: Doubles) -> Doubles:
    """Return linear colours [N, 3] that the browser shows as linear colours ``shown`` [N, 3]."""
    a, b, c, d, e = _FIT
    wanted = np.clip(np.clip(shown, 0.0, 1.0) @ np.linalg.inv(_OUT).T, 0.0, _BRIGHTEST)
    # (1 - c y) x^2 + (a - d y) x + (b - e y) = 0
    square, linear, constant = 1.0 - c * wanted, a - d * wanted, b - e * wanted
    bright = (-linear + np.sqrt(linear**2 - 4.0 * square * constant)) / (2.0 * square)
    return np.asarray(bright @ np.linalg.inv(_IN).T / _EXPOSURE, np.float64)
