"""The field of a map: that of each region, blended where regions overlap."""

from collections.abc import Sequence

import numpy as np
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.field_settings import FieldSettings

from triquad_map.composition.region import FieldRegion, FieldValues
from triquad_map.composition.region_lattice import Owned, Owners


class BlendedField:
    """The fields of all regions as one."""

    def __init__(self, settings: FieldSettings, regions: Sequence[FieldRegion]) -> None:
        self._settings = settings
        self._regions = regions

    def values(self, points: Doubles, owners: Owners, gradient: bool) -> FieldValues:
        """The field at points [N, 3], whose owners are known."""
        several = np.flatnonzero(owners.shared)
        if len(owners.groups) == 1 and not len(several):
            (owned,) = owners.groups
            if isinstance(owned.points, slice):
                return self._of_one(owned, points, gradient)
        count = len(points)
        values = FieldValues(
            np.full(count, np.nan, np.float32),
            np.full((count if gradient else 0, 3), np.nan, np.float32),
        )
        for owned in owners.groups:
            _put(values, owned.points, self._of_one(owned, points, gradient))
        if len(several):
            _put(values, several, self._blend(points[several], gradient))
        return values

    def _of_one(self, owned: Owned, points: Doubles, gradient: bool) -> FieldValues:
        """The field of the region that owns some of the points."""
        region = self._regions[owned.region]
        local = (points[owned.points] - region.centre).astype(np.float32)
        return region.engine.evaluate(local, gradient)

    def _blend(self, points: Doubles, gradient: bool) -> FieldValues:
        """Blend the regions that cover each point, so that there is no step where they overlap."""
        half = self._settings.region_side_m / 2
        weight_sum = np.zeros(len(points))
        value_sum = np.zeros(len(points))
        slope_sum = np.zeros((len(points), 3))  # of weight * value
        tilt_sum = np.zeros((len(points), 3))  # of weight
        for region in self._regions:
            offsets = points - region.centre
            mine = np.flatnonzero((np.abs(offsets) < half).all(axis=1))
            if len(mine) == 0:
                continue
            inside = half - np.abs(offsets[mine])
            ramps = np.clip(inside / self._settings.overlap_m, 0, 1)
            weights = ramps.prod(axis=1)
            values = region.engine.evaluate(offsets[mine].astype(np.float32), gradient)
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


def _put(values: FieldValues, where: slice | Longs, new: FieldValues) -> None:
    """Put ``new`` values in their places."""
    values.sdf[where] = new.sdf
    if len(values.gradient):
        values.gradient[where] = new.gradient


def _ramp_gradient(offsets: Doubles, ramps: Doubles, overlap_m: float) -> Doubles:
    """Gradient [N, 3] of the product of the three ramps."""
    slopes = np.where((ramps > 0) & (ramps < 1), -np.sign(offsets) / overlap_m, 0.0)
    others = np.stack(
        [ramps[:, 1] * ramps[:, 2], ramps[:, 0] * ramps[:, 2], ramps[:, 0] * ramps[:, 1]], axis=1
    )
    return slopes * others
