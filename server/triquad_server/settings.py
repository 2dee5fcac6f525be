"""Settings of the server: one record per section, with ranges and descriptions.

:mod:`triquad_server.settings_loading` reads them from a file, the environment and the command line.
"""

from typing import Annotated

from pydantic import BaseModel, Field, ValidationError, model_validator
from triquad_format.errors import FormatError, SettingsError
from triquad_format.records.field_settings import FieldSettings
from triquad_format.wire.keys import check_name

from triquad_server.leaf_lengths import DEFAULT_LEAF_M, at_leaf, follows_leaf, length
from triquad_server.memory_settings import MemorySettings
from triquad_server.metrics_settings import MetricsSettings
from triquad_server.ros2_settings import Ros2Settings
from triquad_server.scan_settings import ScanSettings
from triquad_server.settings_section import RECORD, SECTION
from triquad_server.source_settings import SourceSettings, check_robot_box

Key = tuple[str, ...]
"""A setting: its section, for a source its name, and its key."""

_RANGES = ("range_min_m", "range_max_m")


class TrainingSettings(BaseModel):
    """How the field is trained."""

    model_config = SECTION

    batch: Annotated[int, Field(ge=1, le=10_000_000)] = 16_384
    """Samples per step."""

    learning_rate: Annotated[float, Field(ge=0, le=1)] = 0.01
    """Learning rate of Adam, before it cools."""

    beta1: Annotated[float, Field(ge=0.001, le=0.9999)] = 0.9
    """Decay of Adam's mean of gradients."""

    beta2: Annotated[float, Field(ge=0.001, le=0.99999)] = 0.99
    """Decay of Adam's mean of squared gradients; at least the square of `beta1`."""

    pool_rays: Annotated[int, Field(ge=100, le=1_000_000_000)] = 1_200_000
    """What so many rays taught is kept for training, over the whole map."""

    fresh_share: Annotated[float, Field(ge=0, le=1)] = 0.5
    """Share of a batch that is drawn from the newest scans while they stream in."""

    samples_per_ray: Annotated[float, Field(ge=0, le=1000)] = 48.0
    """Each new ray raises the training budget of its region by so many samples."""

    max_budget_samples: Annotated[int, Field(ge=1, le=10_000_000_000)] = 24_000_000
    """Largest training budget of a region, in samples."""

    cooldown: Annotated[float, Field(ge=0.001, le=1000)] = 8.0
    """The learning rate falls once the budget is less than this many samples per kept ray."""

    max_regions: Annotated[int, Field(ge=1, le=1_000_000)] = 256
    """Regions of the map; a scan that would need more is refused."""

    seed: Annotated[int, Field(ge=0, le=2**31)] = 42
    """Seed of all random choices."""

    @model_validator(mode="after")
    def _steps_are_bounded(self) -> "TrainingSettings":
        """Kingma and Ba, section 4."""
        if self.beta2 < self.beta1**2:
            raise ValueError(
                f"training.beta2 = {self.beta2} is too small for training.beta1 = {self.beta1}: "
                f"use at least {self.beta1**2:.6g}"
            )
        return self


class ChangeSettings(BaseModel):
    """How quickly a surface is taken back that rays pass through, in a world that changes."""

    model_config = SECTION

    static: bool = False
    """The world stands still: no surface is ever taken back."""

    scans: Annotated[int, Field(ge=1, le=1000)] = 3
    """Scans in a row, at least, of which rays pass where a surface was, and none ends there."""

    doubt: Annotated[float, Field(ge=1e-9, le=0.5)] = 0.01
    """How probable such rays may be, at most, if the surface were still there: told by how often
    rays ended and passed there before."""


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

    update_timeout_max_s: Annotated[float, Field(ge=0.1, le=3600)] = 60.0
    """Longest time that a request for changes may wait, whatever the client asks for."""

    reply_bytes: Annotated[int, Field(ge=1000, le=100_000_000)] = 1_000_000
    """Bytes of tiles in one reply; a single tile may be larger."""

    client_bytes_per_s: Annotated[int, Field(ge=0, le=2**40)] = 0
    """Bytes of tiles that each client is sent per second; 0: no limit but its own."""

    cache_bytes: Annotated[int, Field(ge=0, le=2**40)] = 200_000_000
    """Bytes of encoded tiles that are cached; others are made again when they are asked for."""


class StoreSettings(BaseModel):
    """When checkpoints are written and how far back they are kept."""

    model_config = SECTION

    period_s: Annotated[float, Field(ge=0, le=1e7)] = 60.0
    """Time between checkpoints while the map changes; 0: only on request."""

    keep: Annotated[int, Field(ge=2, le=1_000_000)] = 20
    """Newest checkpoints that stay on disk; two always do."""

    keep_age_s: Annotated[float, Field(ge=0, le=1e10)] = 0.0
    """Older checkpoints are deleted; 0: of any age stay."""

    keep_bytes: Annotated[int, Field(ge=0, le=2**60)] = 4_000_000_000
    """The oldest checkpoints are deleted while all take more; 0: no limit."""

    protect_h: Annotated[float, Field(ge=0, le=1e6)] = 24.0
    """Hours for which the map as it was before a reset stays on disk, whatever the limits above
    say; 0: a reset keeps nothing."""

    protect_bytes: Annotated[int, Field(ge=0, le=2**60)] = 4_000_000_000
    """Bytes of all checkpoints that are kept for that. A reset that would need more is refused: so
    nothing pushes out what is kept already; 0: no limit."""

    scrub_h: Annotated[float, Field(ge=0, le=1e6)] = 24.0
    """Hours between checks of all checkpoints on disk, which find what rots there; 0: none."""


class ServiceSettings(BaseModel):
    """Limits of the network service."""

    model_config = SECTION

    scan_queue: Annotated[int, Field(ge=1, le=10_000)] = 32
    """Scans of each source that wait; the oldest is pushed out, and counted. Sources take turns."""

    scan_queue_bytes: Annotated[int, Field(ge=1_000_000, le=2**40)] = 100_000_000
    """Bytes of the scans of all sources that wait; the oldest of the source that has most of them
    is pushed out."""

    request_queue: Annotated[int, Field(ge=1, le=10_000)] = 64
    """Requests that wait, per group of operations; of more, the newest of the client that has most
    of them is refused."""

    request_queue_bytes: Annotated[int, Field(ge=0, le=2**40)] = 64_000_000
    """Bytes of the requests that wait, per group of operations, likewise."""

    request_timeout_max_s: Annotated[float, Field(ge=0.1, le=1e6)] = 60.0
    """A request is given up after this time, or after the shorter one for which its client
    waits."""

    query_workers: Annotated[int, Field(ge=1, le=64)] = 2
    """Threads that answer queries of the field, as many for distances and spheres, and as many for
    segments, rays, ground and grids."""

    max_query_points: Annotated[int, Field(ge=1, le=20_000_000)] = 1_000_000
    """Points of one request for the field."""

    max_search_points: Annotated[int, Field(ge=1, le=20_000_000)] = 250_000
    """Points of one request that searches around points."""

    publish_period_s: Annotated[float, Field(ge=0.01, le=3600)] = 0.5
    """Time between epochs while the map changes."""

    epochs_kept: Annotated[int, Field(ge=1, le=1000)] = 4
    """Newest epochs that requests can ask for by number."""

    epochs_pinned: Annotated[int, Field(ge=0, le=1000)] = 8
    """Older epochs that stay because they were asked for by number, of all clients together."""

    client_pins: Annotated[int, Field(ge=1, le=1000)] = 3
    """Epochs that one client may pin; of more, the one that it asked for longest ago goes."""

    pin_s: Annotated[float, Field(ge=0, le=1e6)] = 30.0
    """Time for which an epoch stays after it was last asked for by number."""

    changes_kept: Annotated[int, Field(ge=0, le=100_000_000)] = 1_000_000
    """Voxels whose surface appeared or vanished that are remembered, each change of each, for
    clients that ask what changed: 13 bytes each."""

    flush_timeout_max_s: Annotated[float, Field(ge=0.1, le=1e6)] = 600.0
    """Longest time that a client may ask to wait in a flush."""


class UnfitSettingsError(ValueError):
    """Settings that do not go together."""

    def __init__(self, text: str, keys: tuple[Key, ...]) -> None:
        super().__init__(text)
        self.keys = keys  # that decide


class Settings(BaseModel):
    """All settings; each part of the server receives its own section.

    Lengths that are not given are in proportion to ``field.leaf_m``.
    """

    model_config = RECORD

    field: FieldSettings = FieldSettings()
    scan: ScanSettings = ScanSettings()
    change: ChangeSettings = ChangeSettings()
    training: TrainingSettings = TrainingSettings()
    mesh: MeshSettings = MeshSettings()
    store: StoreSettings = StoreSettings()
    service: ServiceSettings = ServiceSettings()
    memory: MemorySettings = MemorySettings()
    metrics: MetricsSettings = MetricsSettings()
    ros2: Ros2Settings = Ros2Settings()
    sources: dict[str, SourceSettings] = {}

    @model_validator(mode="after")
    def _lengths_follow_the_leaf(self) -> "Settings":
        # Not yet in anyone's hands, so this is no change of what is frozen.
        for name in ("scan", "mesh"):
            self.__dict__[name] = at_leaf(self.__dict__[name], self.field.leaf_m)
        return self

    @model_validator(mode="after")
    def _sections_fit(self) -> "Settings":
        self._check_ranges(*(("scan", key) for key in _RANGES))
        cell, reach = ("mesh", "cell_m"), ("mesh", "reach_m")
        most_m = 4 * self.field.leaf_m
        if self._value(cell) + self._value(reach) > most_m:
            raise UnfitSettingsError(
                f"{self._said(cell)} and {self._said(reach)} are too coarse for field.leaf_m = "
                f"{self.field.leaf_m:g}: together, use at most {most_m:g}",
                keys=(cell, reach),
            )
        return self

    @model_validator(mode="after")
    def _sources_fit(self) -> "Settings":
        for name, source in self.sources.items():
            try:
                check_name("source", name)
            except FormatError as error:
                raise ValueError(f"sources: {error}") from error
            self._check_ranges(
                *(
                    ("scan", key) if getattr(source, key) is None else ("sources", name, key)
                    for key in _RANGES
                )
            )
            if (box := source.robot_box_m) is not None:
                check_robot_box(f"sources.{name}.robot_box_m", box, self.field.leaf_m)
        return self

    def scan_of(self, source: SourceSettings) -> ScanSettings:
        """The section ``[scan]`` with the ranges of a source."""
        ranges = source.model_dump(include=set(_RANGES), exclude_none=True)
        return self.scan.model_copy(update=ranges)

    def with_field(self, field: FieldSettings) -> "Settings":
        """The same for another field, whose leaf the lengths follow that are not given.

        Raises:
            SettingsError: those that are given do not go with it.
        """
        try:
            return Settings(**dict(self) | {"field": field})
        except ValidationError as error:
            texts = [str(details["ctx"]["error"]) for details in error.errors()]
            raise SettingsError("; ".join(texts)) from error

    def _check_ranges(self, nearest: Key, farthest: Key) -> None:
        low_m, high_m, thin = self._value(nearest), self._value(farthest), ("scan", "thin_m")
        if high_m < low_m:
            raise UnfitSettingsError(
                f"{self._said(farthest)} is less than {self._said(nearest)}: use at least that",
                keys=(nearest, farthest),
            )
        most_m = 8 * self.field.region_pitch_m
        if high_m > most_m:
            raise UnfitSettingsError(
                f"{self._said(farthest)} reaches over too many regions of field.leaf_m = "
                f"{self.field.leaf_m:g} and field.depth = {self.field.depth}: use at most "
                f"{most_m:g}, or larger regions",
                keys=(farthest,),
            )
        if self._value(thin) * 1e6 < high_m:
            raise UnfitSettingsError(
                f"{self._said(thin)} is too fine for {self._said(farthest)}: use at least "
                f"{high_m * 1e-6:g}",
                keys=(thin, farthest),
            )

    def _value(self, key: Key) -> float:
        return float(getattr(self._table(key), key[-1]))

    def _said(self, key: Key) -> str:
        """A setting with its value, and where that comes from if nobody gave it."""
        follows = follows_leaf(self._table(key), key[-1]) and self.field.leaf_m != DEFAULT_LEAF_M
        why = f" (which follows field.leaf_m = {self.field.leaf_m:g})" if follows else ""
        return f"{'.'.join(key)} = {self._value(key):g}{why}"

    def _table(self, key: Key) -> BaseModel:
        table: BaseModel = getattr(self, key[0]) if len(key) == 2 else self.sources[key[1]]
        return table
