"""The sections of the settings, a record each: fields with ranges, and what they mean.

A length that is not given follows the side of the field's leaves.
"""

import math
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field
from pydantic.config import JsonDict
from triquad_format.records.field_settings import FieldSettings

DEFAULT_LEAF_M = FieldSettings().leaf_m
"""The defaults of lengths are those at this leaf."""

IN_LEAVES = "in_leaves"
"""In the JSON schema of a setting: how many leaves long its default is."""

_DIGITS = 9  # of a length: the default times a ratio has noise behind them

RECORD = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)
# Neither text nor a truth value is a number.
SECTION = RECORD | ConfigDict(strict=True)


SectionT = TypeVar("SectionT", bound=BaseModel)


def length(default_m: float, least_m: float, most_m: float) -> Any:
    """A length that follows ``field.leaf_m`` unless it is given.

    The range has to hold what follows from any leaf.
    """
    leaves: JsonDict = {IN_LEAVES: _rounded(default_m / DEFAULT_LEAF_M)}
    return Field(default=default_m, ge=least_m, le=most_m, json_schema_extra=leaves)


def at_leaf(section: SectionT, leaf_m: float) -> SectionT:
    """The section with each length that was not given in proportion to the leaf."""
    lengths = {
        name: _rounded(setting.default * (leaf_m / DEFAULT_LEAF_M))
        for name, setting in type(section).model_fields.items()
        if follows_leaf(section, name)
    }
    # A copy would count them as given, and they could not follow another leaf.
    return type(section).model_construct(section.model_fields_set, **dict(section) | lengths)


def follows_leaf(section: BaseModel, name: str) -> bool:
    """Whether a setting of a section follows the leaf: a length that was not given."""
    extra = type(section).model_fields[name].json_schema_extra
    return isinstance(extra, dict) and IN_LEAVES in extra and name not in section.model_fields_set


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


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

    behind_m: float = length(0.8, least_m=0, most_m=100)
    """Samples of free space end so far behind the end point."""

    max_points: Annotated[int, Field(ge=1, le=20_000_000)] = 500_000
    """Of a scan with more rays, thinned, an even part is used. One of more than five times as many
    points is refused."""


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

    ray_origin_m: _Corner = (0.0, 0.0, 0.0)
    """Where its rays begin, metres, in the frame of its scans: where the lidar sits, if a driver
    publishes points in the frame of the robot's base. Ranges count from there."""

    robot_box_m: Box | None = None
    """Two corners, metres, in the frame of its scans, of the space that the robot takes up: points
    in it are dropped, and where the robot has been it is free."""


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


class ChangeSettings(BaseModel):
    """Whether a surface is removed that rays pass through, in a world that changes."""

    model_config = SECTION

    static: bool = False
    """The world stands still: no surface is ever removed."""


class TrainingSettings(BaseModel):
    """How the field is trained."""

    model_config = SECTION

    batch: Annotated[int, Field(ge=1, le=10_000_000)] = 16_384
    """Samples per step, at most: it is one for each 14 vertices of a region, so
    that a street learns alike in one region and across several. While scans stream in, it is half
    of that: of as many samples, more and smaller steps learn sooner."""

    learning_rate: Annotated[float, Field(ge=0, le=1)] = 0.01
    """Learning rate of Adam, before it cools."""

    rays_per_voxel: Annotated[float, Field(ge=0.01, le=10_000)] = 12.0
    """Rays that are kept for training, for each voxel with surface, spread evenly over them. The
    training budget is at most 20 samples for each."""

    pool_bytes: Annotated[int, Field(ge=10_000, le=2**50)] = 500_000_000
    """Bytes of all rays in memory, and at most a quarter of `memory.max_bytes`; where there are too
    many voxels for that, fewer are kept for each."""

    fresh_share: Annotated[float, Field(ge=0, le=1)] = 0.25
    """Share of a batch that is drawn from the newest scans while they stream in."""

    samples_per_ray: Annotated[float, Field(ge=0, le=1000)] = 48.0
    """Samples by which each new ray raises the training budget of its region."""

    max_regions: Annotated[int, Field(ge=1, le=1_000_000)] = 4096
    """Regions of the map; a scan that would need more is refused."""

    seed: Annotated[int, Field(ge=0, le=2**31)] = 42
    """Seed of all random choices."""


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

    cache_bytes: Annotated[int, Field(ge=0, le=2**40)] = 200_000_000
    """Bytes of encoded tiles that are cached, and at most a tenth of what the program leaves of
    `memory.max_bytes`; others are made again when they are asked for."""


class StoreSettings(BaseModel):
    """When checkpoints are written and how far back they are kept."""

    model_config = SECTION

    period_s: Annotated[float, Field(ge=0, le=1e7)] = 60.0
    """Time between checkpoints while the map changes; 0: only on request."""

    keep: Annotated[int, Field(ge=2, le=1_000_000)] = 20
    """Newest checkpoints that stay on disk; two always do."""

    keep_resets: Annotated[int, Field(ge=0, le=1000)] = 10
    """Newest resets of which the map just before stays as well; 0: a reset keeps nothing."""

    keep_bytes: Annotated[int, Field(ge=0, le=2**60)] = 4_000_000_000
    """The oldest checkpoints are deleted while all take more, but for two; 0: no limit."""

    log_max_bytes: Annotated[int, Field(ge=0, le=2**60)] = 0
    """Bytes of scans that are kept with the checkpoints, to make the map again with other settings
    or better poses; the oldest go; 0: none are kept."""

    scrub_h: Annotated[float, Field(ge=0, le=1e6)] = 24.0
    """Hours between checks of all checkpoints on disk, which find what rots there; 0: none."""


class ServiceSettings(BaseModel):
    """Limits of the network service."""

    model_config = SECTION

    scan_queue: Annotated[int, Field(ge=1, le=10_000)] = 32
    """Scans of each source that wait; the oldest is pushed out, and counted. Sources take turns."""

    request_queue: Annotated[int, Field(ge=1, le=10_000)] = 64
    """Requests of each client that wait, and an eighth of those of all; of more, the newest of the
    client that has most of them is refused."""

    publish_period_s: Annotated[float, Field(ge=0.01, le=3600)] = 0.5
    """Time between epochs while the map changes."""

    epochs_kept: Annotated[int, Field(ge=1, le=1000)] = 4
    """Newest epochs that requests can ask for by number; a while after the last one was published,
    the newest alone."""

    epochs_pinned: Annotated[int, Field(ge=0, le=1000)] = 8
    """Older epochs that stay because they were asked for by number; of more, the one that was asked
    for longest ago is removed."""

    pin_s: Annotated[float, Field(ge=0, le=1e6)] = 30.0
    """Time for which an epoch stays after it was last asked for by number."""


class MemorySettings(BaseModel):
    """How much memory the server may take."""

    model_config = SECTION

    max_bytes: Annotated[int, Field(ge=1_000_000, le=2**50)] = 2_000_000_000
    """Of the process in all; of a server within a program, of what it holds. Maps have the same
    share each. Before more is needed, regions that no scan has reached for longest leave memory,
    and are read from the store where they are needed. Without a store a scan that would make
    the map larger is refused as `map_full`; one that shows nothing new is taken on, and all else
    goes on too."""

    epochs_bytes: Annotated[int, Field(ge=0, le=2**50)] = 300_000_000
    """Of older epochs that can be asked for by number, beyond what they share with newer ones, and
    at most a tenth of what the program leaves of `max_bytes`; those that were asked for last stay
    first."""


class MetricsSettings(BaseModel):
    """Figures for Prometheus and health for supervisors, over HTTP."""

    model_config = SECTION

    port: Annotated[int, Field(ge=0, le=65535)] = 0
    """Where `/metrics` and `/healthz` are answered; 0: nowhere. The flag `--metrics-port` says the
    same."""

    address: Annotated[str, Field(min_length=1, max_length=255)] = "127.0.0.1"
    """Address of the network interface that is listened on: `0.0.0.0` for all; all who reach it may
    read."""
