"""The field of a map: that of each region, blended where regions overlap."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.field_settings import FieldSettings

from triquad_map.compiled.region_lattice import Owned


@dataclass(frozen=True)
class FieldValues:
    """Signed distances [N] and, where asked for, their gradients [N, 3] (else [0, 3])."""

    sdf: NDArray[np.float32]
    gradient: NDArray[np.float32]


class FieldEngine(Protocol):
    """What computes the field of one region."""

    def evaluate(self, points: NDArray[np.float32], gradient: bool) -> FieldValues:
        """The field at points [N, 3], metres from the region's centre."""


class PlacedField(Protocol):
    """The field of a region and where it is."""

    @property
    def centre(self) -> NDArray[np.float64]:
        """[3] metres, map frame."""

    @property
    def engine(self) -> FieldEngine:
        """What computes it."""


class BlendedField:
    """The fields of all regions as one."""

    def __init__(self, settings: FieldSettings, regions: Sequence[PlacedField]) -> None:
        self._settings = settings
        self._regions = regions

    def values(
        self,
        points: NDArray[np.float64],
        groups: Iterable[Owned],
        shared: NDArray[np.bool_],
        gradient: bool,
    ) -> FieldValues:
        """The field at points [N, 3]: who owns them, and which of them others may cover, too."""
        count = len(points)
        values = FieldValues(
            np.full(count, np.nan, np.float32),
            np.full((count if gradient else 0, 3), np.nan, np.float32),
        )
        for owned in groups:
            region = self._regions[owned.region]
            local = (points[owned.points] - region.centre).astype(np.float32)
            _put(values, owned.points, region.engine.evaluate(local, gradient))
        several = np.flatnonzero(shared)
        if len(several):
            _put(values, several, self._blend(points[several], gradient))
        return values

    def _blend(self, points: NDArray[np.float64], gradient: bool) -> FieldValues:
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


def _put(values: FieldValues, where: slice | NDArray[np.int64], new: FieldValues) -> None:
    """Put ``new`` values in their places."""
    values.sdf[where] = new.sdf
    if len(values.gradient):
        values.gradient[where] = new.gradient


def _ramp_gradient(
    offsets: NDArray[np.float64],
    ramps: NDArray[np.float64],
    overlap_m: float,
) -> NDArray[np.float64]:
    """Gradient [N, 3] of the product of the three ramps."""
    slopes = np.where((ramps > 0) & (ramps < 1), -np.sign(offsets) / overlap_m, 0.0)
    others = np.stack(
        [ramps[:, 1] * ramps[:, 2], ramps[:, 0] * ramps[:, 2], ramps[:, 0] * ramps[:, 1]],
        axis=1,
    )
    return slopes * others
