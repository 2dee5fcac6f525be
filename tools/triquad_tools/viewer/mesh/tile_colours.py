"""What the colours of the mesh say."""

import math
from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from triquad_client.calls.queries import MapQueries
from triquad_format.records.arrays import Doubles
from triquad_map.height_scale import HeightScale

from triquad_tools.plots.mesh_normals import vertex_normals
from triquad_tools.viewer.page.colour_scale import ColourScale, scale_colours
from triquad_tools.viewer.page.unlit_glb import Triangles
from triquad_tools.viewer.sources.map_source import Tile

_TOWARDS_SUN = np.array([-0.50, -0.58, 0.64]) / np.linalg.norm([-0.50, -0.58, 0.64])
_SUN, _SKY = 0.55, 0.5
_STEP_M = 0.5  # of the ends of the scale: it stays the same as the map grows a little
_OLDEST_LOG2 = 10  # of ages, in epochs
_NEAR_M = 1.0  # around a vertex, where its surface is looked for


class TileColours(Protocol):
    """Colours of mesh tiles."""

    @property
    def scale(self) -> ColourScale:
        """What they mean."""

    def key(self, tile: Tile) -> Hashable:
        """Where this is another one, the tile has other colours."""

    def values(self, tile: Tile, triangles: Triangles) -> Doubles:
        """[V] places on the scale, of the vertices of a mesh of the tile."""


@dataclass(frozen=True)
class HeightColours:
    """By height in the map frame."""

    low_m: float
    high_m: float

    @classmethod
    def of_heights(cls, heights: NDArray[np.floating]) -> "HeightColours":
        """A scale for nearly all of heights [N], metres, to half a metre."""
        scale = HeightScale.around(heights)
        low_m = math.floor(scale.low_m / _STEP_M) * _STEP_M
        return cls(low_m, math.ceil(scale.high_m / _STEP_M) * _STEP_M)

    @property
    def scale(self) -> ColourScale:
        """Metres; what is beyond has the colour of the end."""
        return ColourScale("height, m", self.low_m, self.high_m, open_below=True, open_above=True)

    def key(self, tile: Tile) -> Hashable:  # noqa: ARG002
        """The scale, which is that of all tiles."""
        return self

    def values(self, tile: Tile, triangles: Triangles) -> Doubles:
        """Heights of the vertices."""
        return np.asarray(tile.origin[2] + triangles.vertices[:, 2], np.float64)


@dataclass(frozen=True)
class AgeColours:
    """By how long ago the surface of a tile last changed, in epochs."""

    newest: int  # epoch of the newest tile

    @classmethod
    def of_tiles(cls, tiles: Iterable[Tile]) -> "AgeColours":
        """Ages seen from the newest of some tiles."""
        return cls(max((tile.version for tile in tiles), default=0))

    @property
    def scale(self) -> ColourScale:
        """Powers of two, since most changes are recent."""
        ticks = ["1", "4", "16", "64", "256", "1024"]
        return ColourScale(
            "epochs since it changed", 0.0, _OLDEST_LOG2, open_above=True, ticks=ticks
        )

    def key(self, tile: Tile) -> Hashable:
        """The power of two."""
        return self._log2(tile)

    def values(self, tile: Tile, triangles: Triangles) -> Doubles:
        """One for the whole tile."""
        return np.full(len(triangles.vertices), float(self._log2(tile)))

    def _log2(self, tile: Tile) -> int:
        return min(max(self.newest - tile.version, 1).bit_length() - 1, _OLDEST_LOG2)


@dataclass(frozen=True)
class ConfidenceColours:
    """By how much the rays have shown of the surface, as the map answers for its distances."""

    queries: MapQueries

    @property
    def scale(self) -> ColourScale:
        """From 0 to 1."""
        return ColourScale("confidence", 0.0, 1.0)

    def key(self, tile: Tile) -> Hashable:
        """That of the tile's own version."""
        return tile.version

    def values(self, tile: Tile, triangles: Triangles) -> Doubles:
        """Asked for at the vertices."""
        points = tile.origin + triangles.vertices
        answer = self.queries.query_distance(points, max_distance_m=_NEAR_M)
        return answer.confidence.astype(np.float64)


def lit_colours(colours: TileColours, tile: Tile, triangles: Triangles) -> Doubles:
    """Linear colours [V, 3] of the vertices of a tile, in the light of a sun and a bright sky."""
    plain = scale_colours(colours.scale, colours.values(tile, triangles))
    up = vertex_normals(triangles.vertices.astype(np.float64), triangles.faces)
    light = _SUN * np.maximum(up @ _TOWARDS_SUN, 0.0) + _SKY * (0.75 + 0.25 * up[:, 2])
    return np.asarray(plain * light[:, None], np.float64)
