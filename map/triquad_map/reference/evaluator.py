"""The field and the status at points, with numpy alone: the reference for every other engine.

``docs/map-file.md`` gives the formulae. Positions are float64 in the map frame and become float32
once they are relative to a region's centre.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.errors import FormatError
from triquad_format.records import morton
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import (
    AXES,
    BLOCK_VOXELS,
    Evidence,
    MapRecord,
    Region,
    VertexTable,
    leaf_coordinates,
    region_centre,
)
from triquad_format.records.status import Status

CHUNK_POINTS = 65_536

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

_CORNERS = ((0, 0), (1, 0), (0, 1), (1, 1))


@dataclass(frozen=True)
class Answer:
    """What the map says of N points."""

    sdf: NDArray[np.float32]  # [N] metres, positive in free space; NaN where no region is
    status: NDArray[np.uint8]  # [N] triquad_format.records.status.Status
    gradient: NDArray[np.float32] | None  # [N, 3] d(sdf)/dx, map frame; NaN as the sdf


class MapEvaluator:
    """Answers queries on one map record. It holds no other state: threads may share it."""

    def __init__(self, record: MapRecord) -> None:
        self._settings = record.settings
        self._regions = [RegionField(record.settings, region) for region in record.regions]

    def query(self, points: NDArray[np.floating], gradient: bool = False) -> Answer:
        """Signed distance, status and, on request, gradient.

        Args:
            points: ``[N, 3]``, metres, map frame.
            gradient: also give d(sdf)/dx.

        Raises:
            FormatError: ``points`` has another shape, or a coordinate is not finite.
        """
        positions: Doubles = np.asarray(points, np.float64)
        check_points(positions)
        sdf = np.empty(len(positions), np.float32)
        status = np.empty(len(positions), np.uint8)
        slope = np.empty((len(positions), 3), np.float32) if gradient else None
        for first in range(0, len(positions), CHUNK_POINTS):
            rows = slice(first, first + CHUNK_POINTS)
            sdf[rows], slopes = self._blend(positions[rows], gradient)
            status[rows] = self._status(positions[rows])
            if slope is not None:
                slope[rows] = slopes
        return Answer(sdf, status, slope)

    def status(self, points: NDArray[np.floating]) -> NDArray[np.uint8]:
        """:class:`Status` values [N] of ``points`` [N, 3]; errors are those of :meth:`query`."""
        positions: Doubles = np.asarray(points, np.float64)
        check_points(positions)
        return self._status(positions)

    def _blend(self, points: Doubles, gradient: bool) -> tuple[Doubles, Doubles]:
        """Distance [N] and gradient [N, 3] (zeros unless asked for), blended over the regions."""
        total = np.zeros(len(points))
        total_slope = np.zeros((len(points), 3))
        value = np.zeros(len(points))
        slope = np.zeros((len(points), 3))
        for region in self._regions:
            offset = points - region.centre
            rows = np.flatnonzero(
                (np.abs(offset) < self._settings.region_side_m / 2).all(axis=1),
            )
            if not len(rows):
                continue
            weight, weight_slope = _blend_weight(self._settings, offset[rows])
            f, f_slope = region.evaluate(offset[rows].astype(np.float32), gradient)
            total[rows] += weight
            value[rows] += weight * f
            if gradient:
                total_slope[rows] += weight_slope
                slope[rows] += weight[:, None] * f_slope + weight_slope * f[:, None]
        with np.errstate(invalid="ignore"):
            value /= total
            if gradient:
                slope = (slope - value[:, None] * total_slope) / total[:, None]
        return value, slope

    def _status(self, points: Doubles) -> NDArray[np.uint8]:
        owner = np.floor(points / self._settings.region_pitch_m + 0.5)
        status = np.full(len(points), Status.UNKNOWN, np.uint8)
        for region in self._regions:
            rows = np.flatnonzero((owner == region.index).all(axis=1))
            if len(rows):
                status[rows] = region.status(points[rows] - region.centre)
        return status


def check_points(points: Doubles) -> None:
    """Raise :class:`FormatError` unless ``points`` are finite and of shape [N, 3]."""
    if points.ndim != 2 or points.shape[1] != 3:
        raise FormatError(f"expected points [N, 3], got {list(points.shape)}")
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        first = int(np.argmin(finite))
        raise FormatError(f"point {first} is not finite: {points[first].tolist()}")


def _blend_weight(settings: FieldSettings, offset: Doubles) -> tuple[Doubles, Doubles]:
    """Weight [N] of a region at offsets [N, 3] from its centre, and its gradient [N, 3]."""
    ramp = (settings.region_side_m / 2 - np.abs(offset)) / settings.overlap_m
    per_axis = np.clip(ramp, 0.0, 1.0)
    steepness = np.where(ramp < 1.0, -np.sign(offset) / settings.overlap_m, 0.0)
    slope = np.empty_like(offset)
    for axis in range(3):
        others = np.delete(per_axis, axis, axis=1).prod(axis=1)
        slope[:, axis] = steepness[:, axis] * others
    return per_axis.prod(axis=1), slope


class _VertexLookup:
    """Feature vectors of one plane and level by vertex; an absent vertex gives zeros."""

    def __init__(self, table: VertexTable) -> None:
        self._rows_of = table.rows_of
        zeros = np.zeros((1, table.features.shape[1]), np.float32)
        self._features = np.concatenate([table.vectors(), zeros])

    def __call__(self, cells: NDArray[np.int64]) -> Floats:
        """Features [N, d] of the vertices at integer coordinates [N, 2]."""
        features: Floats = self._features[self._rows_of(cells)]
        return features


class RegionField:
    """The field and the evidence of one region. Outside of its cube it has no features."""

    def __init__(self, settings: FieldSettings, region: Region) -> None:
        self.index = region.index
        self.centre = region_centre(settings, region.index)
        self._settings = settings
        self._lookups = [(table, _VertexLookup(table)) for table in region.tables]
        self._turns = (2 * math.pi * region.frequencies).astype(np.float32)
        self._mlp = region.mlp
        self._evidence = _EvidenceLookup(region.evidence)

    def evaluate(self, local: Floats, gradient: bool) -> tuple[Doubles, Doubles]:
        """Distance [N] and gradient [N, 3] (zeros unless asked for) at ``local`` [N, 3].

        ``local`` is in metres from the region's centre.
        """
        parts: list[Floats] = []
        slopes = np.zeros((3, len(local), self._settings.input_size if gradient else 0), np.float32)
        column = 0
        if self._settings.encoding != "fourier":
            features = self._features(local, slopes if gradient else None)
            column = features.shape[1]
            parts.append(features)
        if self._settings.encoding != "features":
            parts.append(self._fourier(local, slopes[:, :, column:] if gradient else None))
        value, sensitivity = self._decode(np.concatenate(parts, axis=1), gradient)
        scale = np.float32(self._settings.logit_scale_m)
        f = (value * scale).astype(np.float64)
        f_slope = np.zeros((len(local), 3))
        if gradient:
            f_slope[:] = np.einsum("anc,nc->na", slopes, sensitivity) * scale
        return f, f_slope

    def _features(self, local: Floats, slopes: Floats | None) -> Floats:
        """Interpolated features [N, H * d]; their d/dx goes into ``slopes`` [3, N, ...]."""
        settings = self._settings
        size = settings.feature_size
        leaf = np.float32(settings.leaf_m)
        u = leaf_coordinates(settings, local)
        features = np.zeros((len(local), settings.feature_levels * size), np.float32)
        for table, lookup in self._lookups:
            axes = AXES[table.plane]
            first = (table.level - settings.levels.start) * size
            columns = slice(first, first + size)
            scale = np.float32(1 << (settings.depth - table.level))
            v = u[:, axes] / scale
            floor = np.floor(v)
            t = v - floor
            cell = floor.astype(np.int64)
            outside = ((cell < 0) | (cell >= 1 << table.level)).any(axis=1)
            cell[outside] = 0
            hat = np.stack([1 - t, t])  # [2, N, 2]
            hat[:, outside] = 0
            for a, b in _CORNERS:
                corner = lookup(cell + (a, b))
                features[:, columns] += (hat[a, :, 0] * hat[b, :, 1])[:, None] * corner
                if slopes is not None:
                    rise_a = (2 * a - 1) * hat[b, :, 1] / (scale * leaf)
                    rise_b = (2 * b - 1) * hat[a, :, 0] / (scale * leaf)
                    slopes[axes[0], :, columns] += rise_a[:, None] * corner
                    slopes[axes[1], :, columns] += rise_b[:, None] * corner
        return features

    def _fourier(self, local: Floats, slopes: Floats | None) -> Floats:
        """Fourier features [N, 6m]; their d/dx goes into ``slopes`` [3, N, 6m]."""
        half = np.float32(self._settings.region_side_m / 2)
        angle = (local / half)[:, :, None] * self._turns  # [N, 3, m]
        sine, cosine = np.sin(angle), np.cos(angle)
        if slopes is not None:
            count = len(self._turns)
            for axis in range(3):
                at = slice(axis * count, (axis + 1) * count)
                behind = slice((axis + 3) * count, (axis + 4) * count)
                slopes[axis, :, at] = cosine[:, axis] * (self._turns / half)
                slopes[axis, :, behind] = -sine[:, axis] * (self._turns / half)
        width = 3 * len(self._turns)
        return np.concatenate([sine.reshape(-1, width), cosine.reshape(-1, width)], axis=1)

    def _decode(self, x: Floats, gradient: bool) -> tuple[Floats, Floats]:
        """Output [N] of the MLP and, on request, its derivative [N, input] by the input."""
        weights, biases = self._mlp.weights, self._mlp.biases
        first = np.maximum(x @ weights[0] + biases[0], 0)
        second = np.maximum(first @ weights[1] + biases[1], 0)
        value = (second @ weights[2] + biases[2])[:, 0]
        if not gradient:
            return value, np.zeros((0, 0), np.float32)
        back = (second > 0) * weights[2][:, 0]
        back = (first > 0) * (back @ weights[1].T)
        return value, back @ weights[0].T

    def status(self, offset: Doubles) -> NDArray[np.uint8]:
        """Status [N] of points that the region owns, at ``offset`` [N, 3] from its centre.

        Owned points lie half an overlap inside the cube: no voxel here is out of range.
        """
        u = leaf_coordinates(self._settings, offset)
        free = self._evidence.seen(np.floor(u).astype(np.int64), self._evidence.free)
        status = np.where(free, Status.FREE, Status.UNKNOWN).astype(np.uint8)
        sides = np.floor(np.stack([u - 0.5, u + 0.5])).astype(np.int64)  # [2, N, 3]
        for x in range(2):
            for y in range(2):
                for z in range(2):
                    voxel = np.stack([sides[x, :, 0], sides[y, :, 1], sides[z, :, 2]], axis=1)
                    seen = self._evidence.seen(voxel, self._evidence.surface)
                    status[seen] = Status.SURFACE
        return status


class _EvidenceLookup:
    """Bits of the evidence by voxel."""

    def __init__(self, evidence: Evidence) -> None:
        self._codes = evidence.codes
        self.surface = evidence.surface
        self.free = evidence.free

    def seen(self, voxels: NDArray[np.int64], masks: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Whether the bit of each voxel [N, 3] is set in ``masks``."""
        if not len(self._codes):
            return np.zeros(len(voxels), np.bool_)
        block, inner = np.divmod(voxels, BLOCK_VOXELS)
        codes = morton.encode(block)
        rows = np.minimum(np.searchsorted(self._codes, codes), len(self._codes) - 1)
        octets = masks[rows, inner[:, 0] * BLOCK_VOXELS + inner[:, 1]]
        bits = (octets >> inner[:, 2].astype(np.uint8)) & 1
        seen: NDArray[np.bool_] = (bits != 0) & (self._codes[rows] == codes)
        return seen
