"""A field that answers from arrays which do not change, such as those of an epoch or of a file.

At many points of a grid, such as the lattice points of a mesh tile, it takes half the time. Before
its ReLU, the first layer is a sum of what each plane and each axis add to it. Points of a grid
share coordinates, and most of them two with others: each pair is encoded once.
"""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles, Floats, Ints, Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import Region

from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.team import Split
from triquad_map.field.encoding import (
    BATCH,
    PLANE_AXES,
    PointBatch,
    interpolate_plane,
    wave,
)
from triquad_map.field.field import (
    CompiledField,
    FieldArrays,
    add_product,
    batch_for,
    decode_rest,
    evaluate,
    make_field,
)
from triquad_map.field.quadtree import FrozenQuadtree, LiveQuadtree
from triquad_map.surface import FieldValues, SampleField

_Float = TypeVar("_Float", np.float32, np.float64)

_ZERO = np.float32(0)

_WAVE_OF_PLANE = np.array([0, 2, 1])
"""The axis whose Fourier features count with each plane; each counts once."""

_PLANES = np.arange(3)  # as literal numbers they would be compiled for one by one


@inner_kernel(fastmath=True)
def _wave_terms(axes: Floats, field: CompiledField, batch: PointBatch) -> Floats:
    """Return what Fourier features of a grid's coordinates add to the first layer: [3, S, J]."""
    learnt = field.geometry.levels * field.features.shape[1]
    m = len(field.turns_per_m)
    terms = np.empty((3, axes.shape[1], len(field.mlp.b1)), np.float32)
    for first in range(0, axes.shape[1], BATCH):
        for t in range(BATCH):
            for axis in range(3):
                batch.points[axis, t] = axes[axis, min(first + t, axes.shape[1] - 1)]
        wave(batch, learnt, field.turns_per_m)
        for axis in range(3):
            batch.h1[:] = 0
            for start in (learnt + axis * m, learnt + (3 + axis) * m):
                part = slice(start, start + m)
                add_product(field.mlp.w1[part], batch.x[part], batch.h1)
            for t in range(min(BATCH, axes.shape[1] - first)):
                for j in range(len(batch.h1)):
                    terms[axis, first + t, j] = batch.h1[j, t]
    return terms


@kernel()
def _pairs(points: Longs, u: int, v: int, side: int, numbers: Ints) -> Longs:
    """Return the different pairs [P, 2] of coordinates ``u`` and ``v``, and each point's pair."""
    known = np.full((side, side), -1, np.int32)
    pairs = np.empty((min(len(points), side * side), 2), np.int64)
    count = 0
    for i in range(len(points)):
        first, second = points[i, u], points[i, v]
        if known[first, second] < 0:
            known[first, second] = count
            pairs[count, 0], pairs[count, 1] = first, second
            count += 1
        numbers[i] = known[first, second]
    return pairs[:count]


@inner_kernel(fastmath=True)
def _plane_terms(
    axes: Floats,
    points: Longs,
    plane: int,
    field: CompiledField,
    batch: PointBatch,
    waves: Floats,
    numbers: Ints,
) -> Floats:
    """Return what one plane adds to the first layer at pairs [P, 2] of its coordinates: [P, J].

    Each brings along the waves of one axis. Fills in which of them each point has.
    """
    learnt = field.geometry.levels * field.features.shape[1]
    pairs = _pairs(points, PLANE_AXES[plane, 0], PLANE_AXES[plane, 1], axes.shape[1], numbers)
    terms = np.empty((len(pairs), len(field.mlp.b1)), np.float32)
    brought = _WAVE_OF_PLANE[plane]
    for first in range(0, len(pairs), BATCH):
        count = min(BATCH, len(pairs) - first)
        for t in range(BATCH):
            for k in range(2):
                axis = PLANE_AXES[plane, k]
                batch.points[axis, t] = axes[axis, pairs[first + min(t, count - 1), k]]
        batch.h1[:] = 0
        if learnt > 0:
            interpolate_plane(batch, plane, field.geometry, field.vertices, field.features)
            add_product(field.mlp.w1[:learnt], batch.x[:learnt], batch.h1)
        for t in range(count):
            along = waves[brought, pairs[first + t, 0 if PLANE_AXES[plane, 0] == brought else 1]]
            for j in range(len(along)):
                terms[first + t, j] = batch.h1[j, t] + along[j]
    return terms


@kernel(fastmath=True)
def _evaluate_in_grid(axes: Floats, points: Longs, field: CompiledField, logits: Floats) -> None:
    """Fill ``logits`` [N] at ``points`` [N, 3], by their numbers on the ``axes`` [3, S] of a grid.

    Those of a point do not depend on which others are asked for: mesh tiles meet on their faces.
    """
    batch = batch_for(field)
    waves = _wave_terms(axes, field, batch)
    numbers = np.empty((3, len(points)), np.int32)
    on_xy = _plane_terms(axes, points, _PLANES[0], field, batch, waves, numbers[0])
    on_xz = _plane_terms(axes, points, _PLANES[1], field, batch, waves, numbers[1])
    on_yz = _plane_terms(axes, points, _PLANES[2], field, batch, waves, numbers[2])
    sums = np.empty((BATCH, len(field.mlp.b1)), np.float32)
    for first in range(0, len(points), BATCH):
        count = min(BATCH, len(points) - first)
        for t in range(BATCH):
            i = first + min(t, count - 1)
            a, b, c = on_xy[numbers[0, i]], on_xz[numbers[1, i]], on_yz[numbers[2, i]]
            for j in range(len(field.mlp.b1)):
                sums[t, j] = max(field.mlp.b1[j] + a[j] + b[j] + c[j], _ZERO)
        for j in range(len(field.mlp.b1)):
            for t in range(BATCH):
                batch.h1[j, t] = sums[t, j]
        decode_rest(batch, field.mlp)
        for t in range(count):
            logits[first + t] = batch.logits[t]


class FrozenField:
    """A field that answers from arrays, which nothing may change from then on."""

    def __init__(self, settings: FieldSettings, tree: FrozenQuadtree, arrays: FieldArrays) -> None:
        self.settings = settings
        self.tree = tree
        self.arrays = arrays
        self._field = make_field(settings, tree, arrays)

    def evaluate(self, points: Floats, gradient: bool) -> FieldValues:
        """Return the field at points [N, 3], metres from the centre; on the caller's thread."""
        logits = np.empty(len(points), np.float32)
        gradients = np.empty((len(points) if gradient else 0, 3), np.float32)
        evaluate(points, self._field, logits, gradients)
        scale = np.float32(self.settings.logit_scale_m)
        return FieldValues(logits * scale, gradients * scale)

    def evaluate_in_grid(self, axes: Floats, points: Longs) -> Floats:
        """Return distances [N] at ``points`` [N, 3] of a grid, by their numbers on its ``axes``.

        ``axes`` [3, S] are metres from the region's centre. Those of a point do not depend on which
        others are asked for. On the caller's thread.
        """
        logits = np.empty(len(points), np.float32)
        _evaluate_in_grid(axes, points, self._field, logits)
        distances: Floats = logits * np.float32(self.settings.logit_scale_m)
        return distances


def in_grid(axes: NDArray[_Float], points: Longs) -> NDArray[_Float]:
    """Return points [N, 3] of a grid with coordinates ``axes`` [3, S], by their numbers there."""
    places = [axis[numbers] for axis, numbers in zip(axes, points.T, strict=True)]
    return np.stack(places, axis=1)


def recorded_field(settings: FieldSettings, region: Region) -> FrozenField:
    """Return the field of a region as a file has it."""
    tree = LiveQuadtree(settings)
    features = [np.zeros((1, settings.feature_size), np.float32)]  # row 0: absent vertices
    for table in region.tables:
        h = table.level - settings.levels.start
        tree.restore(table.plane, h, table.codes.astype(np.int64))
        features.append(table.vectors())
    layers = zip(region.mlp.weights, region.mlp.biases, strict=True)
    arrays = FieldArrays(
        np.concatenate(features),
        tuple(np.ascontiguousarray(array, np.float32) for layer in layers for array in layer),
        np.asarray(region.frequencies, np.float32),
    )
    return FrozenField(settings, tree.freeze(), arrays)


def field_samples(engine: FrozenField, settings: FieldSettings, split: Split) -> SampleField:
    """Return the field of a region in voxels, at its leaf coordinates."""

    def sample(voxels: Doubles) -> FieldValues:
        local = settings.offsets(voxels).astype(np.float32)
        values = np.empty(len(local), np.float32)
        gradients = np.empty((len(local), 3), np.float32)

        def work(first: int, last: int) -> None:
            part = engine.evaluate(local[first:last], True)
            values[first:last] = part.sdf / settings.leaf_m
            gradients[first:last] = part.gradient

        split(len(local), work)
        return FieldValues(values, gradients)

    return sample
