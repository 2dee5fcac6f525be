"""Answers of a map, from section 8 of docs/map-file.md and nothing of the project."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from support.files.spec_parts import (
    FREE,
    PLANES,
    SURFACE,
    UNKNOWN,
    Array,
    Key,
    Region,
    Settings,
    Table,
)


def interpolated(table: Table, v: Array) -> tuple[Array, Array, Array]:
    """g and its derivatives by the two coordinates of v."""
    base = np.floor(v)
    t, w = (v - base)[:, :1], (v - base)[:, 1:]
    f00, f10, f01, f11 = (
        table(base.astype(np.int64) + corner) for corner in ((0, 0), (1, 0), (0, 1), (1, 1))
    )
    value = (1 - t) * (1 - w) * f00 + t * (1 - w) * f10 + (1 - t) * w * f01 + t * w * f11
    by_t = (1 - w) * (f10 - f00) + w * (f11 - f01)
    return value, by_t, (1 - t) * (f01 - f00) + t * (f11 - f10)


def features_at(region: Region, x: Array) -> tuple[Array, Array]:
    """Features [N, L S] and their Jacobian [N, L S, 3]."""
    settings = region.settings
    u = x / np.float32(settings.leaf) + np.float32(2.0 ** (settings.depth - 1))
    width = settings.feature_size
    values = np.zeros((len(x), settings.sizes * width), np.float32)
    jacobian = np.zeros((*values.shape, 3), np.float32)
    for k, level in enumerate(settings.levels):
        node, column = 2.0 ** (settings.depth - level), slice(k * width, (k + 1) * width)
        for plane, (i, j) in enumerate(PLANES):
            table = region.tables[plane, level]
            g, by_i, by_j = interpolated(table, u[:, (i, j)] / np.float32(node))
            values[:, column] += g
            jacobian[:, column, i] += by_i / np.float32(node * settings.leaf)
            jacobian[:, column, j] += by_j / np.float32(node * settings.leaf)
    return values, jacobian


def fourier_at(region: Region, x: Array) -> tuple[Array, Array]:
    """Fourier features [N, 6 m] and their Jacobian [N, 6 m, 3]."""
    half = np.float32(region.settings.side / 2)
    turns = np.float32(2 * np.pi) * region.frequencies
    angle = (x / half)[:, :, None] * turns
    flat = (len(x), angle[0].size) if len(x) else (0, 3 * len(turns))
    sin, cos = np.sin(angle).reshape(flat), np.cos(angle).reshape(flat)
    slope = np.repeat(np.eye(3, dtype=np.float32), len(turns), 0) * np.tile(turns, 3)[:, None]
    outer = np.concatenate([cos, -sin], 1)[:, :, None] * np.tile(slope / half, (2, 1))
    return np.concatenate([sin, cos], 1), outer


def field_at(region: Region, x: Array) -> tuple[Array, Array]:
    """f and its gradient in one region; x in single precision from its centre."""
    kinds = {"features": [features_at], "fourier": [fourier_at], "both": [features_at, fourier_at]}
    inputs = [kind(region, x) for kind in kinds[region.settings.encoding]]
    values, jacobian = (np.concatenate(column, 1) for column in zip(*inputs, strict=True))
    w1, w2, w3 = region.weights
    b1, b2, b3 = region.biases
    y1 = values @ w1 + b1
    y2 = np.maximum(y1, 0) @ w2 + b2
    logit = np.maximum(y2, 0) @ w3 + b3
    back = (((y2 > 0) * w3[:, 0]) @ w2.T * (y1 > 0)) @ w1.T
    scale = np.float32(region.settings.logit)
    return logit[:, 0] * scale, np.einsum("nk,nka->na", back, jacobian) * scale


class Map:
    """Answers from the parts of a map, or from those near the points."""

    def __init__(self, facts: dict[str, Any], parts: dict[Key, bytes]) -> None:
        self.settings = Settings(facts["settings"])
        self.origin = origin_of(facts)
        heads = [key[1] for key in parts if key[0] == "/triquad/region"]
        self.regions = {index: Region(self.settings, parts, index) for index in heads}

    def distance(self, points: Array) -> tuple[Array, Array]:
        """Section 8.2: distance and gradient."""
        points = points - self.origin
        total, value = np.zeros((2, len(points)))
        slope, total_slope = np.zeros((2, len(points), 3))
        for region in self.regions.values():
            used = self.settings.inside(points, region.index)
            d = points[used] - region.centre
            f, gradient = field_at(region, d.astype(np.float32))
            w, by_p = weight(self.settings, d)
            total[used] += w
            value[used] += w * f
            slope[used] += w[:, None] * gradient + f[:, None] * by_p
            total_slope[used] += by_p
        total[total == 0] = np.nan
        sdf = value / total
        return sdf, (slope - sdf[:, None] * total_slope) / total[:, None]

    def status(self, points: Array) -> NDArray[np.uint8]:
        """Section 8.3."""
        points = points - self.origin
        result = np.full(len(points), UNKNOWN, np.uint8)
        owners = np.floor(points / self.settings.pitch + 0.5).astype(np.int64)
        for region in self.regions.values():
            owned = (owners == region.index).all(1)
            u = self.settings.leaf_coordinates(points[owned], region.index)
            halves = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3), -1).reshape(-1, 3)
            surface = np.any([bits(region.surface, np.floor(u + half)) for half in halves], 0)
            free = bits(region.free, np.floor(u))
            result[owned] = np.where(surface, SURFACE, np.where(free, FREE, UNKNOWN))
        return result


def origin_of(facts: dict[str, Any]) -> Array:
    """Section 5.1: from where all else in the map counts."""
    packed = facts.get("origin")
    return np.zeros(3) if packed is None else np.frombuffer(packed["data"], "<f8")


def weight(settings: Settings, d: Array) -> tuple[Array, Array]:
    """The weight of a region and its derivative."""
    ramp = (settings.side / 2 - np.abs(d)) / settings.overlap
    factors = np.clip(ramp, 0, 1)
    slope = np.where(ramp < 1, -np.sign(d) / settings.overlap, 0)
    x, y, z = factors.T
    return x * y * z, slope * np.stack([y * z, x * z, x * y], 1)


def bits(table: Table, voxels: Array) -> NDArray[np.bool_]:
    voxels = voxels.astype(np.int64)
    x, y, z = (voxels % 8).T
    rows = table(voxels // 8)
    return (rows[np.arange(len(rows)), 8 * x + y] >> z & 1).astype(bool)
