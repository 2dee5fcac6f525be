"""The field and the status of a map of many regions.

Regions stand on a fixed lattice and overlap. Each point is owned by the region whose centre is
nearest and has the status that this one gives it; the field is blended where regions overlap. In
its core, away from the overlap, a region is the only one that covers a point.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Bytes, Doubles, Floats, Longs
from triquad_format.records.field_settings import FieldSettings, RegionIndex
from triquad_format.records.status import Status

from triquad_map.compiled.team import MIN_SHARE, Split, in_one
from triquad_map.evidence.evidence import FrozenEvidence
from triquad_map.field.frozen_field import FrozenField, in_grid
from triquad_map.surface import FieldValues
from triquad_map.surfels.ray_planes import ShownField
from triquad_map.surfels.surfel_map import SurfelMap
from triquad_map.view import REACH_VOXELS, FieldAnswer


class MapRegion(Protocol):
    """A region of a map that does not change."""

    @property
    def index(self) -> RegionIndex:
        """The index of the region."""

    @property
    def centre(self) -> Doubles:
        """[3] metres, map frame."""

    @property
    def field(self) -> FrozenField | ShownField:
        """Its field."""

    @property
    def evidence(self) -> FrozenEvidence:
        """The space that rays have shown of it."""

    @property
    def newest_s(self) -> int:
        """When a ray last ended anywhere in it, seconds since 1970; 0: never, or not known."""

    def surfels_between(self, low: Doubles, high: Doubles) -> Sequence[SurfelMap]:
        """Return at least its surfels between two corners [3]; not within a :class:`Split`."""


@dataclass(frozen=True)
class Owned:
    """Points of a query that one region answers for."""

    region: MapRegion
    points: slice | NDArray[np.intp]  # which of the query's


@dataclass(frozen=True)
class Owners:
    """The regions that answer for N points."""

    groups: Sequence[Owned]  # the points that have an owner, region by region
    shared: NDArray[np.intp]  # points that other regions may cover, too


class FieldView:
    """Field and status of an immutable map, for any thread."""

    def __init__(
        self, settings: FieldSettings, regions: Sequence[MapRegion], split: Split = in_one
    ) -> None:
        """View regions; ``split`` shares the work of a question among threads."""
        self._settings = settings
        self.region_views = tuple(regions)
        self._split = split
        self._regions_at = {region.index: region for region in regions}
        self._cells = np.array([region.index for region in regions], np.float64).reshape(-1, 3).T

    def query(self, points: Doubles, gradient: bool = False) -> FieldAnswer:
        """Return signed distance, status and, on request, gradient at points [N, 3], map frame."""
        count = len(points)
        sdf = np.empty(count, np.float32)
        status = np.empty(count, np.uint8)
        slopes = np.empty((count, 3), np.float32) if gradient else None

        def work(part: slice, owners: Owners) -> None:
            values = self._values(points[part], owners, gradient)
            sdf[part] = values.sdf
            if slopes is not None:
                slopes[part] = values.gradient
            self._put_status(status[part], points[part], owners, REACH_VOXELS)

        self._for_owners(points, work)
        return FieldAnswer(sdf, status, slopes)

    def distances(self, points: Doubles) -> Floats:
        """Return signed distances [N] alone at points [N, 3] of the map frame."""
        distances = np.empty(len(points), np.float32)

        def work(part: slice, owners: Owners) -> None:
            distances[part] = self._values(points[part], owners, False).sdf

        self._for_owners(points, work)
        return distances

    def distances_in_grid(self, axes: Doubles, points: Longs) -> Floats:
        """Do as :meth:`distances`, but for rounding, at points of a grid: in half the time.

        Args:
            axes: [3, S] its coordinates on each axis, metres, map frame.
            points: [N, 3] the points, by their numbers on the axes.
        """
        region = self._only_region(axes.min(axis=1), axes.max(axis=1))
        if region is None:
            return self.distances(in_grid(axes, points))
        local = (axes - region.centre[:, None]).astype(np.float32)
        distances = np.empty(len(points), np.float32)

        def work(first: int, last: int) -> None:
            distances[first:last] = region.field.evaluate_in_grid(local, points[first:last])

        self._split(len(points), work)
        return distances

    def _only_region(self, low: Doubles, high: Doubles) -> MapRegion | None:
        """Return the region that alone covers the box between two corners [3], if one does."""
        pitch_m = self._settings.region_pitch_m
        core_m = self._settings.region_side_m / 2 - self._settings.overlap_m
        cells = []
        for least, most in zip(low.tolist(), high.tolist(), strict=True):
            place = least / pitch_m
            if not math.isfinite(place):  # of no points, or of some that are nowhere
                return None
            cell = math.floor(place + 0.5)
            if not cell * pitch_m - core_m <= least <= most <= cell * pitch_m + core_m:
                return None
            cells.append(cell)
        return self._regions_at.get((cells[0], cells[1], cells[2]))

    def status(self, points: Doubles, reach_m: float | None = None) -> Bytes:
        """Return status values [N] of points [N, 3]: what the evidence of each point's region says.

        ``SURFACE`` reaches ``reach_m`` beyond the voxels in which rays ended; half a voxel if
        not given.
        """
        reach = REACH_VOXELS if reach_m is None else reach_m / self._settings.leaf_m
        status = np.empty(len(points), np.uint8)

        def work(part: slice, owners: Owners) -> None:
            self._put_status(status[part], points[part], owners, reach)

        self._for_owners(points, work)
        return status

    def surface_in_grid(self, axes: Doubles, reach_m: float) -> Bools:
        """Return which points [S, S, S] of a grid have the status ``SURFACE``, by :meth:`status`.

        ``axes`` [3, S] are their coordinates on each axis, increasing, metres, map frame.
        """
        reach = reach_m / self._settings.leaf_m
        surface = np.zeros(axes.shape[1:] * 3, np.bool_)
        cells = np.floor(axes / self._settings.region_pitch_m + 0.5)
        for region in self.region_views:
            owned = [
                slice(*np.searchsorted(axis, (at, at + 1)))
                for axis, at in zip(cells, region.index, strict=True)
            ]
            if all(own.start < own.stop for own in owned):
                voxels = self._settings.leaf_coordinates(axes - region.centre[:, None])
                mine = [axis[own] for axis, own in zip(voxels, owned, strict=True)]
                surface[tuple(owned)] = region.evidence.surface_in_grid(mine, reach)
        return surface

    def near_ends(self, points: Doubles, reach_m: float) -> Bools:
        """Return whether points [N, 3] lie where rays ended.

        That is within ``reach_m`` of a voxel in which they did, on each axis, and on no side of it
        beyond the last end, unless the surface goes on in a voxel there, or so few scans hit it
        that all may have missed what lies beyond.
        """
        reach = reach_m / self._settings.leaf_m
        near = np.zeros(len(points), np.bool_)

        def work(part: slice, owners: Owners) -> None:
            for owned in owners.groups:
                voxels = self._voxels(owned.region, points[part][owned.points])
                near[part][owned.points] = owned.region.evidence.near_ends(voxels, reach)

        self._for_owners(points, work)
        return near

    def _for_owners(
        self, points: Doubles, work: Callable[[slice, Owners], None], least: int = MIN_SHARE
    ) -> None:
        """Do work on parts of points [N, 3], given the owners of each part's points."""
        self._split(
            len(points),
            lambda first, last: work(slice(first, last), self._owners(points[first:last])),
            least,
        )

    def _owners(self, points: Doubles) -> Owners:
        """Return which regions answer for points [N, 3], metres, map frame."""
        # Axis by axis, which makes every step here one of long vectors.
        by_axis = np.ascontiguousarray(points.T)
        only = self._only_region(
            by_axis.min(axis=1, initial=np.inf), by_axis.max(axis=1, initial=-np.inf)
        )
        if only is not None:
            return Owners([Owned(only, slice(None))], np.zeros(0, np.intp))
        with np.errstate(invalid="ignore", over="ignore"):  # of points that are nowhere
            places = by_axis / self._settings.region_pitch_m
            cells = np.floor(places + 0.5)
            places -= cells
        core_m = self._settings.region_side_m / 2 - self._settings.overlap_m
        off_m = np.abs(places, out=places).max(axis=0, initial=0.0) * self._settings.region_pitch_m
        low = cells.min(axis=1, initial=np.inf)[:, None]
        high = cells.max(axis=1, initial=-np.inf)[:, None]
        outside = ((self._cells < low) | (self._cells > high)).any(axis=0)
        groups = []
        for number in np.flatnonzero(~outside).tolist():
            region = self.region_views[number]
            if (low == high).all():
                groups.append(Owned(region, slice(None)))
                continue
            x, y, z = region.index
            mine = np.flatnonzero((cells[0] == x) & (cells[1] == y) & (cells[2] == z))
            if len(mine):
                groups.append(Owned(region, mine))
        return Owners(groups, np.flatnonzero(off_m > core_m))

    def _put_status(self, status: Bytes, points: Doubles, owners: Owners, reach: float) -> None:
        """Put the status of points [N, 3], whose owners are known, into ``status`` [N]."""
        status[:] = Status.UNKNOWN
        for owned in owners.groups:
            voxels = self._voxels(owned.region, points[owned.points])
            status[owned.points] = owned.region.evidence.status(voxels, reach)

    def _voxels(self, region: MapRegion, points: Doubles) -> Doubles:
        """Return the leaf coordinates [N, 3] of points in a region."""
        return self._settings.leaf_coordinates(points - region.centre)

    def _values(self, points: Doubles, owners: Owners, gradient: bool) -> FieldValues:
        """Return the field at points [N, 3], whose owners are known."""
        slopes = np.full((len(points) if gradient else 0, 3), np.nan, np.float32)
        values = FieldValues(np.full(len(points), np.nan, np.float32), slopes)
        for owned in owners.groups:
            local = (points[owned.points] - owned.region.centre).astype(np.float32)
            _put(values, owned.points, owned.region.field.evaluate(local, gradient))
        if len(owners.shared):
            _put(values, owners.shared, self._blend(points[owners.shared], gradient))
        return values

    def _blend(self, points: Doubles, gradient: bool) -> FieldValues:
        """Blend the regions that cover each point, so that there is no step where they overlap."""
        half = self._settings.region_side_m / 2
        weight_sum = np.zeros(len(points))
        value_sum = np.zeros(len(points))
        slope_sum = np.zeros((len(points), 3))  # of weight * value
        tilt_sum = np.zeros((len(points), 3))  # of weight
        for region in self.region_views:
            offsets = points - region.centre
            mine = np.flatnonzero((np.abs(offsets) < half).all(axis=1))
            if len(mine) == 0:
                continue
            inside = half - np.abs(offsets[mine])
            ramps = np.clip(inside / self._settings.overlap_m, 0, 1)
            weights = ramps.prod(axis=1)
            values = region.field.evaluate(offsets[mine].astype(np.float32), gradient)
            weight_sum[mine] += weights
            value_sum[mine] += weights * values.sdf
            if gradient:
                tilt = _ramp_gradient(offsets[mine], ramps, self._settings.overlap_m)
                slope_sum[mine] += weights[:, None] * values.gradient + tilt * values.sdf[:, None]
                tilt_sum[mine] += tilt
        with np.errstate(invalid="ignore", divide="ignore"):
            sdf = value_sum / weight_sum
            slopes = (slope_sum - sdf[:, None] * tilt_sum) / weight_sum[:, None]
        slopes = slopes[: len(points) if gradient else 0]
        return FieldValues(sdf.astype(np.float32), slopes.astype(np.float32))


def _put(values: FieldValues, where: slice | NDArray[np.intp], new: FieldValues) -> None:
    """Put ``new`` values in their places."""
    values.sdf[where] = new.sdf
    if len(values.gradient):
        values.gradient[where] = new.gradient


def _ramp_gradient(offsets: Doubles, ramps: Doubles, overlap_m: float) -> Doubles:
    """Return gradient [N, 3] of the product of the three ramps."""
    slopes = np.where((ramps > 0) & (ramps < 1), -np.sign(offsets) / overlap_m, 0.0)
    others = np.stack(
        [ramps[:, 1] * ramps[:, 2], ramps[:, 0] * ramps[:, 2], ramps[:, 0] * ramps[:, 1]], axis=1
    )
    return slopes * others
