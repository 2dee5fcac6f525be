"""The field of one region with numpy alone: the reference for every other engine.

``docs/map-file.md`` gives the formulae.
"""

import math
from collections.abc import Iterable, Mapping

import numpy as np
from triquad_format.records import morton
from triquad_format.records.arrays import Floats, Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import AXES, Region, VertexTable

from triquad_map.composition.region import FieldValues, in_grid
from triquad_map.reference.coded_rows import ONE_CELL, CodedRows

_CORNERS = ((0, 0), (1, 0), (0, 1), (1, 1))


class RegionField:
    """The field of one region. Outside of its cube it has no features."""

    def __init__(
        self, settings: FieldSettings, region: Region, shifts: Mapping[int, int] | None = None
    ) -> None:
        """Make the field of a region without its vertices, which :meth:`add` brings.

        ``shifts`` are by level those of the cells in which they come, see :class:`CodedRows`.
        """
        self._settings = settings
        self._features = {
            (plane, level): CodedRows(
                settings.feature_size, np.float32, ONE_CELL if shifts is None else shifts[level]
            )
            for plane in range(len(AXES))
            for level in settings.levels
        }
        self._turns = (2 * math.pi * region.frequencies).astype(np.float32)
        self._mlp = region.mlp

    def add(self, tables: Iterable[VertexTable]) -> None:
        """Add the vertices of some cells."""
        for table in tables:
            self._features[table.plane, table.level].add(table.codes, table.vectors())

    def evaluate(self, points: Floats, gradient: bool) -> FieldValues:
        """Return the field at points [N, 3], metres from the region's centre."""
        parts: list[Floats] = []
        width = self._settings.input_size if gradient else 0
        slopes = np.zeros((3, len(points), width), np.float32)
        column = 0
        if self._settings.encoding != "fourier":
            features = self._interpolate(points, slopes if gradient else None)
            column = features.shape[1]
            parts.append(features)
        if self._settings.encoding != "features":
            parts.append(self._fourier(points, slopes[:, :, column:] if gradient else None))
        value, sensitivity = self._decode(np.concatenate(parts, axis=1), gradient)
        scale = np.float32(self._settings.logit_scale_m)
        if not gradient:
            return FieldValues(value * scale, np.zeros((0, 3), np.float32))
        return FieldValues(value * scale, np.einsum("anc,nc->na", slopes, sensitivity) * scale)

    def evaluate_in_grid(self, axes: Floats, points: Longs) -> Floats:
        """Return distances in a grid; see :class:`triquad_map.composition.region.FieldEngine`."""
        return self.evaluate(in_grid(axes, points), gradient=False).sdf

    def _interpolate(self, local: Floats, slopes: Floats | None) -> Floats:
        """Return interpolated features [N, H * d]; their d/dx goes into ``slopes`` [3, N, ...]."""
        settings = self._settings
        size = settings.feature_size
        leaf = np.float32(settings.leaf_m)
        u = settings.leaf_coordinates(local)
        features = np.zeros((len(local), settings.feature_levels * size), np.float32)
        for (plane, level), vertices in self._features.items():
            axes = AXES[plane]
            first = (level - settings.levels.start) * size
            columns = slice(first, first + size)
            scale = np.float32(1 << (settings.depth - level))
            v = u[:, axes] / scale
            floor = np.floor(v)
            t = v - floor
            cell = floor.astype(np.int64)
            outside = ((cell < 0) | (cell >= 1 << level)).any(axis=1)
            cell[outside] = 0
            hat = np.stack([1 - t, t])  # [2, N, 2]
            hat[:, outside] = 0
            for a, b in _CORNERS:
                corner = vertices.find(morton.encode(cell + (a, b))).rows
                features[:, columns] += (hat[a, :, 0] * hat[b, :, 1])[:, None] * corner
                if slopes is not None:
                    rise_a = (2 * a - 1) * hat[b, :, 1] / (scale * leaf)
                    rise_b = (2 * b - 1) * hat[a, :, 0] / (scale * leaf)
                    slopes[axes[0], :, columns] += rise_a[:, None] * corner
                    slopes[axes[1], :, columns] += rise_b[:, None] * corner
        return features

    def _fourier(self, local: Floats, slopes: Floats | None) -> Floats:
        """Return Fourier features [N, 6m]; their d/dx goes into ``slopes`` [3, N, 6m]."""
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
        """Return output [N] of the MLP and, on request, its derivative [N, input] by the input."""
        weights, biases = self._mlp.weights, self._mlp.biases
        first = np.maximum(x @ weights[0] + biases[0], 0)
        second = np.maximum(first @ weights[1] + biases[1], 0)
        value = (second @ weights[2] + biases[2])[:, 0]
        if not gradient:
            return value, np.zeros((0, 0), np.float32)
        back = (second > 0) * weights[2][:, 0]
        back = (first > 0) * (back @ weights[1].T)
        return value, back @ weights[0].T
