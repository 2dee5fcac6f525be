"""What the colours of the mesh say."""

from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles, Floats, Ints

from triquad_tools.viewer.map_source import Tile
from triquad_tools.viewer.thinning import Triangles

_TOWARDS_SUN = np.array([-0.50, -0.58, 0.64]) / np.linalg.norm([-0.50, -0.58, 0.64])
_SUN, _SKY = 0.55, 0.5
_STEP_M = 0.5
_FRAMED = (1.0, 99.0)  # percentiles of heights
_ENOUGH = 200  # vertices of a tile, to find the range of heights


class TileColours(Protocol):
    """Colours of mesh tiles."""

    def key(self, tile: Tile) -> Hashable:
        """Where this is another one, the tile has other colours."""

    def colours(self, tile: Tile, triangles: Triangles) -> Doubles:
        """[V, 3] linear, of the vertices of a mesh of the tile, without light and shade."""


@dataclass(frozen=True)
class HeightColours:
    """By height in the map frame: dark below, bright above."""

    low_m: float
    high_m: float

    @classmethod
    def of_tiles(cls, tiles: Iterable[Tile]) -> "HeightColours":
        """For nearly all heights that there are, to half a metre."""
        heights = [
            tile.origin[2] + tile.vertices[:: max(1, len(tile.vertices) // _ENOUGH), 2]
            for tile in tiles
        ]
        known = np.concatenate([np.zeros(0), *heights])
        low, high = np.percentile(known, _FRAMED) if len(known) else (0.0, 1.0)
        low_m = float(np.floor(low / _STEP_M) * _STEP_M)
        return cls(low_m, max(float(np.ceil(high / _STEP_M) * _STEP_M), low_m + _STEP_M))

    def key(self, tile: Tile) -> Hashable:  # noqa: ARG002
        """The range of heights."""
        return self.low_m, self.high_m

    def colours(self, tile: Tile, triangles: Triangles) -> Doubles:
        """As :class:`TileColours` has it."""
        heights = tile.origin[2] + triangles.vertices[:, 2].astype(np.float64)
        return scale_colours((heights - self.low_m) / (self.high_m - self.low_m))


def scale_colours(places: NDArray[np.floating]) -> Doubles:
    """Linear colours [N, 3] for places [N] on a scale from 0 to 1."""
    shown = colormaps["cividis"](np.clip(places, 0.0, 1.0))[:, :3]
    return np.asarray(shown**2.2, np.float64)


def lit(colours: Doubles, triangles: Triangles) -> Doubles:
    """The colours [V, 3] in the light of a sun and a bright sky."""
    up = _normals(triangles.vertices, triangles.faces)
    light = _SUN * np.maximum(up @ _TOWARDS_SUN, 0.0) + _SKY * (0.75 + 0.25 * up[:, 2])
    return np.asarray(colours * light[:, None], np.float64)


def _normals(vertices: Floats, faces: Ints) -> Doubles:
    """Unit normals [V, 3] of vertices, the mean of their faces', larger ones counting more."""
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    across = np.cross(second - first, third - first).astype(np.float64)
    summed = np.zeros((len(vertices), 3))
    for corner, axis in np.ndindex(3, 3):
        summed[:, axis] += np.bincount(faces[:, corner], across[:, axis], len(vertices))
    lengths = np.linalg.norm(summed, axis=1, keepdims=True)
    return np.asarray(summed / np.maximum(lengths, 1e-12))
