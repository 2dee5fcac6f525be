"""The lengths of a map's mesh, whose tiles have several levels of detail."""

from dataclasses import dataclass

from triquad_format.wire.limits import LEVELS

COARSEST = LEVELS - 1
"""Level of detail of the tiles of which a whole map is shown."""


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
