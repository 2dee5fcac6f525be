"""Settings of the section ``[scan]``."""

from typing import Annotated, Literal

from pydantic import BaseModel, Field

from triquad_server.settings.leaf_lengths import length
from triquad_server.settings.section import SECTION


class ScanSettings(BaseModel):
    """Which points of a scan are used, and where its rays are sampled."""

    model_config = SECTION

    range_min_m: float = length(1.5, least_m=0, most_m=1000)
    """Nearer points are dropped."""

    range_max_m: float = length(50.0, least_m=0, most_m=1e4)
    """How far rays reach: farther points are dropped, and the space up to this range is free, as
    on rays without a return. At least `range_min_m`."""

    thin_m: float = length(0.05, least_m=1e-3, most_m=10)
    """One point is kept per voxel of this side, or per patch, as the sensor sees it."""

    thin_by: Literal["voxel", "direction"] = "voxel"
    """Of which points one is kept: of those in a voxel, or of those in the same direction and,
    within a fifth, the same distance. Voxels keep the rows of a lidar on flat tops; of a dense
    sensor with noise they keep too many outliers."""

    surface_share: Annotated[float, Field(ge=0.01, le=1)] = 0.5
    """Share of the training samples that lie around end points; the others lie in free space."""

    spread_m: float = length(0.08, least_m=1e-3, most_m=10)
    """Standard deviation of the distance of samples from their end point, along the ray."""

    truncation_m: float = length(0.3, least_m=0.01, most_m=20)
    """Largest distance of such samples from their end point."""

    behind_m: float = length(0.8, least_m=0, most_m=100)
    """Samples of free space end so far behind the end point."""

    max_points: Annotated[int, Field(ge=1, le=20_000_000)] = 500_000
    """A larger scan is refused."""
