"""Settings of the section ``[training]``."""

from typing import Annotated

from pydantic import BaseModel, Field

from triquad_server.settings.section import SECTION


class TrainingSettings(BaseModel):
    """How the field is trained."""

    model_config = SECTION

    batch: Annotated[int, Field(ge=1, le=10_000_000)] = 16_384
    """Samples per step, at most: it is one for each 14 vertices of a region, and at least 4096, so
    that a street learns alike in one region and across several. While scans stream in, it is half
    of that: of as many samples, more and smaller steps learn sooner."""

    learning_rate: Annotated[float, Field(ge=0, le=1)] = 0.01
    """Learning rate of Adam, before it cools."""

    pool_rays: Annotated[int, Field(ge=100, le=1_000_000_000)] = 1_200_000
    """Rays that are kept for training, over the whole map, spread evenly over its surface; a large
    map keeps more, by `rays_per_voxel`."""

    rays_per_voxel: Annotated[float, Field(ge=0.01, le=10_000)] = 12.0
    """A large map keeps so many rays for each voxel with surface."""

    pool_bytes: Annotated[int, Field(ge=10_000, le=2**50)] = 500_000_000
    """Bytes of all rays that are kept; a map too large for that keeps fewer for each voxel."""

    fresh_share: Annotated[float, Field(ge=0, le=1)] = 0.25
    """Share of a batch that is drawn from the newest scans while they stream in."""

    samples_per_ray: Annotated[float, Field(ge=0, le=1000)] = 48.0
    """Each new ray raises the training budget of its region by so many samples."""

    max_budget_samples: Annotated[int, Field(ge=1, le=10_000_000_000)] = 24_000_000
    """Largest training budget of the map, in samples, shared by its regions as they have surface; a
    large map has a larger one, by `samples_per_voxel`."""

    samples_per_voxel: Annotated[float, Field(ge=0.01, le=1_000_000)] = 240.0
    """The budget of a large map is at most so many samples for each voxel with surface."""

    cooldown: Annotated[float, Field(ge=0.001, le=1000)] = 8.0
    """The learning rate falls once the budget is less than this many samples per kept ray."""

    max_regions: Annotated[int, Field(ge=1, le=1_000_000)] = 256
    """Regions of the map; a scan that would need more is refused."""

    seed: Annotated[int, Field(ge=0, le=2**31)] = 42
    """Seed of all random choices."""
