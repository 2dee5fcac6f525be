"""One region's field at fixed points, evaluated again and again with other features."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import AXES, Region, VertexTable, leaf_coordinates

from triquad_tools.mapfiles.field_change import FieldChange, draw_probes

Floats = NDArray[np.float32]

_CORNERS = ((0, 0), (1, 0), (0, 1), (1, 1))


class RegionProbes:
    """Points where rays have been; what does not hang on the features is computed once."""

    def __init__(self, settings: FieldSettings, region: Region, rng: np.random.Generator) -> None:
        self._probes = draw_probes(settings, region, rng)
        self._region = region
        self._settings = settings
        local = self._probes.points.astype(np.float32)
        self._corners = [_TableCorners(settings, table, local) for table in region.tables]
        weight = region.mlp.weights[0]
        features = settings.feature_levels * settings.feature_size
        features = 0 if settings.encoding == "fourier" else features
        self._feature_weight = weight[:features]
        self._fixed = _fixed_input(settings, region, local, weight[features:])
        vectors = [table.vectors() for table in region.tables]
        self._reference = self._distances(vectors)
        self.level_slopes: NDArray[np.float64] = self._rms_slopes(vectors)
        """Rms derivative [H] of the distance by a feature of each level, metres."""

    def change(self, vectors: Sequence[Floats]) -> FieldChange:
        """How far distances move where the tables have these feature vectors, each [V, S]."""
        return self._probes.change(self._distances(vectors) - self._reference)

    def _hidden(self, vectors: Sequence[Floats]) -> Floats:
        """First hidden layer [P, hidden], before its ReLU."""
        hidden: Floats = self._fixed.copy()
        if not len(self._feature_weight):
            return hidden
        size = self._settings.feature_size
        for table, corners, values in zip(self._region.tables, self._corners, vectors, strict=True):
            first = (table.level - self._settings.levels.start) * size
            hidden += corners.interpolated(values) @ self._feature_weight[first : first + size]
        return hidden

    def _distances(self, vectors: Sequence[Floats]) -> Floats:
        """Signed distances [P], metres."""
        weights, biases = self._region.mlp.weights, self._region.mlp.biases
        first = np.maximum(self._hidden(vectors), 0)
        second = np.maximum(first @ weights[1] + biases[1], 0)
        logits = (second @ weights[2] + biases[2])[:, 0]
        distances: Floats = logits * np.float32(self._settings.logit_scale_m)
        return distances

    def _rms_slopes(self, vectors: Sequence[Floats]) -> NDArray[np.float64]:
        settings = self._settings
        weights, biases = self._region.mlp.weights, self._region.mlp.biases
        hidden = self._hidden(vectors)
        if not len(self._feature_weight) or not len(hidden):
            return np.ones(settings.feature_levels)
        second = np.maximum(hidden, 0) @ weights[1] + biases[1]
        back = (second > 0) * weights[2][:, 0]
        back = (hidden > 0) * (back @ weights[1].T)
        slopes = (back @ self._feature_weight.T).astype(np.float64) * settings.logit_scale_m
        by_level = slopes.reshape(len(slopes), -1, settings.feature_size)
        rms: NDArray[np.float64] = np.sqrt((by_level**2).mean(axis=(0, 2)))
        return rms


class _TableCorners:
    """Where points lie among the vertices of one table."""

    def __init__(self, settings: FieldSettings, table: VertexTable, local: Floats) -> None:
        u = leaf_coordinates(settings, local)
        v = u[:, AXES[table.plane]] / np.float32(1 << (settings.depth - table.level))
        floor = np.floor(v)
        hat = np.stack([1 - (v - floor), v - floor])  # [2, P, 2]
        least = np.maximum(floor.astype(np.int64), 0)
        self._rows = [table.rows_of(least + corner) for corner in _CORNERS]
        self._weights = [hat[a, :, 0] * hat[b, :, 1] for a, b in _CORNERS]

    def interpolated(self, vectors: Floats) -> Floats:
        """Features [P, S] at the points, from the vectors [V, S] of the vertices."""
        padded = np.concatenate([vectors, np.zeros((1, vectors.shape[1]), np.float32)])
        total = np.zeros((len(self._rows[0]), vectors.shape[1]), np.float32)
        for rows, weights in zip(self._rows, self._weights, strict=True):
            total += weights[:, None] * padded[rows]
        return total


def _fixed_input(settings: FieldSettings, region: Region, local: Floats, weight: Floats) -> Floats:
    """What bias and Fourier features give the first hidden layer, [P, hidden]."""
    fixed = np.repeat(region.mlp.biases[0][None], len(local), axis=0)
    if settings.encoding == "features":
        return fixed
    half = np.float32(settings.region_side_m / 2)
    turns = (2 * math.pi * region.frequencies).astype(np.float32)
    angle = ((local / half)[:, :, None] * turns).reshape(len(local), 3 * len(turns))
    middle = angle.shape[1]
    fixed += np.sin(angle) @ weight[:middle] + np.cos(angle) @ weight[middle:]
    return fixed
