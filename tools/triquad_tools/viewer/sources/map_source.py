"""The interface of a page's map: a server that learns, or a file."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from triquad_client.calls.queries import MapQueries
from triquad_client.checks import Bounds
from triquad_client.mesh.followed_mesh import MeshTile, TileIndex
from triquad_format.wire.limits import LEVELS

COARSEST = LEVELS - 1
"""Level of detail of the tiles of which a whole map is shown."""


class TileFollower(Protocol):
    """The mesh tiles of a level within a box; ``MeshWatch`` is one."""

    @property
    def tiles(self) -> Mapping[TileIndex, MeshTile]:
        """The tiles as of the last :meth:`next`, by their indices."""

    @property
    def complete(self) -> bool:
        """Whether it left nothing pending."""

    def next(self, timeout_s: float) -> object:
        """Fetch some of what changed; return soon, also if there is more.

        Raises:
            TriquadError: it cannot be had now; the tiles stay.
        """

    def close(self) -> None:
        """Stop following."""


@dataclass(frozen=True)
class TileSizes:
    """Lengths of the mesh, metres."""

    cell_m: float  # of level 0
    tile_side_m: float  # of level 0

    def cell_of(self, level: int) -> float:
        """Return the side of the cells of a level."""
        return self.cell_m * (1 << level)

    def side_of(self, level: int) -> float:
        """Return the side of the tiles of a level."""
        return self.tile_side_m * (1 << level)


class MapSource(Protocol):
    """A map to show."""

    @property
    def title(self) -> str:
        """Name of the map, and where it is from."""

    @property
    def queries(self) -> MapQueries:
        """The queries of the map as it is now."""

    @property
    def sizes(self) -> TileSizes:
        """The sizes of its mesh."""

    @property
    def grows(self) -> bool:
        """Whether more of it may become known while it is shown."""

    def follow(
        self, level: int, bounds: Bounds | None = None, before: TileFollower | None = None
    ) -> TileFollower:
        """Follow the tiles of a level that meet ``bounds``, metres, map frame; ``None``: all.

        Tiles of a follower ``before``, of the same level and source, need not be fetched again.
        """
