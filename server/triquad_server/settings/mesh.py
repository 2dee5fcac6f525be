"""Settings of the section ``[mesh]``."""

from typing import Annotated

from pydantic import BaseModel, Field

from triquad_server.settings.leaf_lengths import length
from triquad_server.settings.section import SECTION


class MeshSettings(BaseModel):
    """The lattice of mesh tiles, and how clients follow them."""

    model_config = SECTION

    cell_m: float = length(0.1, least_m=0.005, most_m=10)
    """Side of the cells of marching cubes."""

    tile_cells: Annotated[int, Field(ge=4, le=256)] = 64
    """Cells along the side of a tile."""

    reach_m: float = length(0.02, least_m=0, most_m=1)
    """Centres of faces lie at most this far from voxels with seen surface; twice and four times as
    far on levels of detail 1 and 2."""

    tolerance_m: float = length(0.01, least_m=0, most_m=1)
    """A tile changes where its surface moved by more."""

    update_period_s: Annotated[float, Field(ge=0.01, le=3600)] = 0.5
    """Time between searches for changed tiles, while somebody follows the mesh."""

    cache_bytes: Annotated[int, Field(ge=0, le=2**40)] = 200_000_000
    """Bytes of encoded tiles that are cached; others are made again when they are asked for."""
