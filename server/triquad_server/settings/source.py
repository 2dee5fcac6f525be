"""Settings of one source of scans: a section ``[sources.NAME]`` of the server's settings."""

import math
from typing import Annotated

from pydantic import BaseModel, Field

from triquad_server.settings.section import SECTION

_Coordinate = Annotated[float, Field(ge=-20, le=20)]
# A file has lists, not tuples.
_Corner = Annotated[tuple[_Coordinate, _Coordinate, _Coordinate], Field(strict=False)]
Box = Annotated[tuple[_Corner, _Corner], Field(strict=False)]

_MAX_BOX_VOXELS = 100_000  # that are marked with each scan


class SourceSettings(BaseModel):
    """What is particular to the scans of one source."""

    model_config = SECTION

    range_min_m: Annotated[float, Field(ge=0, le=1000)] | None = None
    """Nearer points are dropped; by default as in `[scan]`."""

    range_max_m: Annotated[float, Field(ge=0, le=1e4)] | None = None
    """How far rays reach; by default as in `[scan]`."""

    no_return: bool = True
    """Whether rays of which a scan says that they met nothing are believed."""

    robot_box_m: Box | None = None
    """Two corners, metres, sensor frame, of the space that the robot takes up: points in it are
    dropped, and where the robot has been it is free."""


ANY_SOURCE = SourceSettings()
"""Of a source that has no section."""


def check_robot_box(name: str, box: Box, leaf_m: float) -> None:
    """Refuse a box that holds nothing, or very many voxels of side ``leaf_m``.

    Raises:
        ValueError: it is named as ``name``.
    """
    sides = [high - low for low, high in zip(*box, strict=True)]
    if min(sides) <= 0:
        raise ValueError(
            f"{name} = {box}: the first corner has the smaller x, y and z, the second the larger"
        )
    if math.prod(side / leaf_m for side in sides) > _MAX_BOX_VOXELS:
        raise ValueError(
            f"{name} = {box} has more than {_MAX_BOX_VOXELS} voxels of field.leaf_m = "
            f"{leaf_m:g}: use a smaller box, or larger leaves"
        )
