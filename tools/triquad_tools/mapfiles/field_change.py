"""Differences of the distances of two maps, measured at random points where rays have been."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import MapRecord, Region, seen_voxels
from triquad_map.record_view import open_view

QUANTILE = 0.99

PROBES = 20_000
"""Points of each kind."""

_LEAST_PROBES = 1000  # of each kind and region
_SURFACE_LEAVES = 1.0  # status SURFACE: half a leaf around the voxel's own half
_NEAR_LEAVES = 1.5
_FREE_LEAVES = 0.5


@dataclass(frozen=True)
class FieldChange:
    """Magnitudes of the change of the distance, metres."""

    surface_m: float  # 99 % quantile where the status is SURFACE
    near_m: float  # up to 1.5 leaves from the centre of a surface voxel, on each axis
    free_m: float  # in voxels that a ray passed through
    largest_m: float  # of all points

    @property
    def quantile_m(self) -> float:
        """The largest of the three quantiles."""
        return max(self.surface_m, self.near_m, self.free_m)


@dataclass(frozen=True)
class Probes:
    """Random points of the kinds of :class:`FieldChange`, metres from a region's centre."""

    surface: Doubles  # [P, 3]
    near: Doubles  # [P, 3]
    free: Doubles  # [P, 3]

    @property
    def points(self) -> Doubles:
        """All of them [N, 3], in the order of the fields."""
        return np.concatenate([self.surface, self.near, self.free])

    def change(self, differences: NDArray[np.floating]) -> FieldChange:
        """Return the quantiles of differences [N] at :attr:`points`."""
        moved = np.abs(differences)
        ends = np.cumsum([len(self.surface), len(self.near)])
        surface, near, free = (_quantile(part) for part in np.split(moved, ends))
        return FieldChange(surface, near, free, largest_m=float(moved.max(initial=0.0)))


def draw_probes(
    settings: FieldSettings, region: Region, rng: np.random.Generator, count: int = PROBES
) -> Probes:
    """Return ``count`` points of each kind; none of a kind of which the evidence knows no voxel."""
    surface = seen_voxels(region.evidence, region.evidence.surface)
    free = seen_voxels(region.evidence, region.evidence.free)
    chosen = [(surface, _SURFACE_LEAVES), (surface, _NEAR_LEAVES), (free, _FREE_LEAVES)]
    middle = (1 << (settings.depth - 1)) - 0.5
    points = []
    for voxels, reach in chosen:
        drawn = voxels[rng.integers(max(len(voxels), 1), size=count if len(voxels) else 0)]
        offset = rng.uniform(-reach, reach, drawn.shape)
        points.append((drawn - middle + offset) * settings.leaf_m)
    return Probes(*points)


def field_change(before: MapRecord, after: MapRecord, seed: int) -> FieldChange:
    """Return how far distances moved between two maps that have the same regions and evidence."""
    rng = np.random.default_rng(seed)
    count = max(PROBES // max(len(before.regions), 1), _LEAST_PROBES)
    kinds: list[list[Doubles]] = [[np.zeros((0, 3))] for _ in range(3)]
    for region in before.regions:
        probes = draw_probes(before.settings, region, rng, count=count)
        centre = before.settings.region_centre(region.index)
        for kind, field in zip(kinds, dataclasses.fields(probes), strict=True):
            kind.append(getattr(probes, field.name) + centre)
    everywhere = Probes(*(np.concatenate(kind) for kind in kinds))
    old, new = (open_view(record).query(everywhere.points).sdf for record in (before, after))
    # Outside the cube of a region at the map's border there is no distance.
    return everywhere.change(np.nan_to_num(new - old))


def _quantile(values: NDArray[np.floating]) -> float:
    return float(np.quantile(values, QUANTILE)) if len(values) else 0.0
