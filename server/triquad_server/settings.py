"""Settings of the server: one small record per part, and their TOML file."""

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from triquad_format.errors import SettingsError
from triquad_format.records.field_settings import FieldSettings, check_range

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


@dataclass(frozen=True)
class ScanSettings:
    """Which points of a scan are used, and where its rays are sampled."""

    range_min_m: float = 1.5
    range_max_m: float = 50.0
    thin_m: float = 0.05  # one point is kept per voxel of this side
    surface_share: float = 0.5  # of the training samples that lie around end points
    spread_m: float = 0.08  # standard deviation of their distance from them, along the ray
    truncation_m: float = 0.3  # and how far from them they lie at most
    free_from: float = 0.3  # free samples begin at this share of the range
    behind_m: float = 0.8  # and end this far behind the end point
    max_points: int = 500_000  # a larger scan is refused

    def __post_init__(self) -> None:
        check_range("range_min_m", self.range_min_m, 0.0, 1e3)
        check_range("range_max_m", self.range_max_m, self.range_min_m, 1e4)
        check_range("thin_m", self.thin_m, 1e-3, 10.0)
        check_range("surface_share", self.surface_share, 0.01, 1.0)
        check_range("spread_m", self.spread_m, 1e-3, 10.0)
        check_range("truncation_m", self.truncation_m, 0.01, 10.0)
        check_range("free_from", self.free_from, 0.0, 1.0)
        check_range("behind_m", self.behind_m, 0.0, 100.0)
        check_range("max_points", self.max_points, 1, 20_000_000)


@dataclass(frozen=True)
class TrainingSettings:
    """How the field is trained."""

    batch: int = 16_384  # samples per step
    learning_rate: float = 0.01
    beta1: float = 0.9
    beta2: float = 0.99
    pool_rays: int = 1_200_000  # what so many rays taught is kept, over the whole map
    fresh_share: float = 0.5  # of a batch, drawn from the newest scans while they stream in
    samples_per_ray: float = 48.0  # by so much each new ray raises the training budget
    max_budget_samples: int = 24_000_000  # training budget at most, per region
    cooldown: float = 8.0  # the rate falls once the budget is below so many samples per kept ray
    max_regions: int = 256  # of the map; a scan that would need more is refused
    seed: int = 42

    def __post_init__(self) -> None:
        check_range("batch", self.batch, 1, 10_000_000)
        check_range("learning_rate", self.learning_rate, 0.0, 1.0)
        check_range("beta1", self.beta1, 0.001, 0.9999)
        check_range("beta2", self.beta2, 0.001, 0.99999)
        if self.beta2 < self.beta1**2:  # steps would grow without a bound (Kingma and Ba, sec. 4)
            raise SettingsError(
                f"beta2 = {self.beta2} is too small for beta1 = {self.beta1}: "
                f"use at least {self.beta1**2:.6g}"
            )
        check_range("pool_rays", self.pool_rays, 100, 1_000_000_000)
        check_range("fresh_share", self.fresh_share, 0.0, 1.0)
        check_range("samples_per_ray", self.samples_per_ray, 0.0, 1000.0)
        check_range("cooldown", self.cooldown, 0.001, 1000.0)
        check_range("max_regions", self.max_regions, 1, 1_000_000)
        check_range("seed", self.seed, 0, 2**31)
        check_range("max_budget_samples", self.max_budget_samples, 1, 10_000_000_000)


@dataclass(frozen=True)
class MeshSettings:
    """The lattice of mesh tiles."""

    cell_m: float = 0.1
    tile_cells: int = 64  # along the side of a tile
    reach_m: float = 0.02  # centres of faces lie at most this far from voxels with seen surface
    tolerance_m: float = 0.01  # a tile changes where its surface moved by more
    update_period_s: float = 0.5  # between looks at what changed, while somebody follows the mesh
    update_timeout_max_s: float = 60.0  # longest that a request is held
    reply_bytes: int = 1_000_000  # of tiles in one reply; one tile may be larger
    client_bytes_per_s: int = 0  # of tiles to each client; 0: no limit
    shelf_bytes: int = 200_000_000  # of encoded tiles that are kept

    def __post_init__(self) -> None:
        check_range("cell_m", self.cell_m, 0.01, 10.0)
        check_range("tile_cells", self.tile_cells, 4, 256)
        check_range("reach_m", self.reach_m, 0.0, 1.0)
        check_range("tolerance_m", self.tolerance_m, 0.0, 1.0)
        check_range("update_period_s", self.update_period_s, 0.01, 3600.0)
        check_range("update_timeout_max_s", self.update_timeout_max_s, 0.1, 3600.0)
        check_range("reply_bytes", self.reply_bytes, 1000, 100_000_000)
        check_range("client_bytes_per_s", self.client_bytes_per_s, 0, 2**40)
        check_range("shelf_bytes", self.shelf_bytes, 0, 2**40)

    @property
    def tile_side_m(self) -> float:
        """Side of a tile."""
        return self.cell_m * self.tile_cells


@dataclass(frozen=True)
class StoreSettings:
    """When checkpoints are written and how far back they are kept."""

    period_s: float = 60.0  # between checkpoints while the map changes; 0: only on request
    keep: int = 20  # newest checkpoints that stay on disk; two always do
    keep_age_s: float = 0.0  # older ones go; 0: of any age
    keep_bytes: int = 4_000_000_000  # as long as all take more, the oldest go; 0: no limit

    def __post_init__(self) -> None:
        check_range("period_s", self.period_s, 0.0, 1e7)
        check_range("keep", self.keep, 2, 1_000_000)
        check_range("keep_age_s", self.keep_age_s, 0.0, 1e10)
        check_range("keep_bytes", self.keep_bytes, 0, 2**60)


@dataclass(frozen=True)
class ServiceSettings:
    """Limits of the network service."""

    scan_queue: int = 32  # scans waiting; the oldest is pushed out, and counted
    request_queue: int = 64  # requests waiting per group of operations
    query_workers: int = 2
    max_query_points: int = 1_000_000  # of one request for the field
    max_search_points: int = 250_000  # of one request that searches around points
    publish_period_s: float = 0.5  # between epochs while the map changes
    epochs_kept: int = 4  # newest epochs that requests can ask for by number
    epochs_pinned: int = 8  # older ones that stay because they were asked for by number
    pin_s: float = 30.0  # and that for so long after the last time
    flush_timeout_max_s: float = 600.0

    def __post_init__(self) -> None:
        check_range("scan_queue", self.scan_queue, 1, 10_000)
        check_range("request_queue", self.request_queue, 1, 10_000)
        check_range("query_workers", self.query_workers, 1, 64)
        check_range("max_query_points", self.max_query_points, 1, 20_000_000)
        check_range("max_search_points", self.max_search_points, 1, 20_000_000)
        check_range("publish_period_s", self.publish_period_s, 0.01, 3600.0)
        check_range("epochs_kept", self.epochs_kept, 1, 1000)
        check_range("epochs_pinned", self.epochs_pinned, 0, 1000)
        check_range("pin_s", self.pin_s, 0.0, 1e6)
        check_range("flush_timeout_max_s", self.flush_timeout_max_s, 0.1, 1e6)


@dataclass(frozen=True)
class Settings:
    """All settings; each part of the server receives its own section."""

    field: FieldSettings = FieldSettings()
    scan: ScanSettings = ScanSettings()
    training: TrainingSettings = TrainingSettings()
    mesh: MeshSettings = MeshSettings()
    store: StoreSettings = StoreSettings()
    service: ServiceSettings = ServiceSettings()

    def __post_init__(self) -> None:
        """Refuse settings that are each in range but do not go together."""
        reach_m = self.scan.range_max_m
        _check_together(
            self.field.region_pitch_m * 8 >= reach_m,
            f"scan.range_max_m = {reach_m:g} reaches over too many regions of field.leaf_m = "
            f"{self.field.leaf_m:g} and field.depth = {self.field.depth}: "
            f"use at most {self.field.region_pitch_m * 8:g}, or larger regions",
        )
        _check_together(
            self.scan.thin_m * 1e6 >= reach_m,
            f"scan.thin_m = {self.scan.thin_m:g} is too fine for scan.range_max_m = {reach_m:g}",
        )
        _check_together(
            4 * (self.mesh.cell_m + self.mesh.reach_m) <= 16 * self.field.leaf_m,
            f"mesh.cell_m = {self.mesh.cell_m:g} and mesh.reach_m = {self.mesh.reach_m:g} are too "
            f"coarse for field.leaf_m = {self.field.leaf_m:g}",
        )


def _check_together(fits: bool, otherwise: str) -> None:
    if not fits:
        raise SettingsError(otherwise)


def load_settings(path: Path) -> Settings:
    """Settings from a TOML file; what it leaves out keeps its default.

    Raises:
        SettingsError: the file cannot be read, or a key is unknown, of the wrong type or out of
            range. The text names the key and what is allowed.
    """
    try:
        sections = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise SettingsError(f"settings file {path}: {error}") from error
    try:
        return parse_settings(sections)
    except SettingsError as error:
        raise SettingsError(f"settings file {path}: {error}") from error


def parse_settings(sections: dict[str, Any]) -> Settings:
    """Settings from nested tables, such as ``{"field": {"leaf_m": 0.3}}``."""
    defaults = Settings()
    known = [part.name for part in dataclasses.fields(Settings)]
    parts: dict[str, Any] = {}
    for name, table in sections.items():
        if name not in known:
            raise SettingsError(f"unknown section [{name}]; known are {', '.join(known)}")
        if not isinstance(table, dict):
            raise SettingsError(f"{name} = {table!r} is not a section: write [{name}]")
        parts[name] = _parse_section(name, type(getattr(defaults, name)), table)
    return dataclasses.replace(defaults, **parts)


def _parse_section(section: str, record: type[Any], table: dict[str, Any]) -> Any:
    known = {entry.name: entry.type for entry in dataclasses.fields(record)}
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key not in known:
            raise SettingsError(f"unknown key {key!r} in [{section}]; known are {', '.join(known)}")
        wanted = known[key]
        if type(value) is int and abs(value) >= 2**63:
            raise SettingsError(f"{section}.{key} is a number of more than 64 bits")
        if wanted is float and type(value) is int:
            value = float(value)
        if type(value) is not wanted:
            kind = getattr(wanted, "__name__", wanted)
            raise SettingsError(f"{section}.{key} = {value!r} is not of type {kind}")
        values[key] = value
    try:
        return record(**values)
    except SettingsError as error:
        raise SettingsError(f"[{section}] {error}") from error
