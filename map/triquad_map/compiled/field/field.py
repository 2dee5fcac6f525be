"""The field's arithmetic in compiled code, for the CPU.

The same field as the tensors of :mod:`triquad_server.engine.tensor_field` compute, which are its
reference: values, gradients with respect to the points and to the parameters. A kernel
runs on one thread and holds no Python lock; callers split the work. Arrays are float32.
"""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Floats, Ints
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import Region

from triquad_map.compiled.field.encoding import (
    BATCH,
    Geometry,
    PointBatch,
    add_feature_gradient,
    add_feature_slopes,
    add_wave_slopes,
    interpolate,
    load,
    locate,
    new_batch,
    wave,
)
from triquad_map.compiled.field.mlp import Mlp, add_weight_gradient, backward, forward, transposed
from triquad_map.compiled.field.quadtree import FrozenQuadtree, LiveQuadtree, Vertices
from triquad_map.compiled.kernel import kernel
from triquad_map.composition.region import FieldValues


class CompiledField(NamedTuple):
    """A field as kernels take it."""

    geometry: Geometry
    vertices: Vertices
    features: Floats  # [rows, d]
    mlp: Mlp
    turns_per_m: Floats  # [m] Fourier frequencies, empty where the field has none


class Touched(NamedTuple):
    """Which feature rows a thread has added a gradient to."""

    stamps: Ints  # [rows] the step in which each row was touched last
    rows: Ints  # [rows] those touched in this step, in the order in which they were


@kernel()
def _batch_for(field: CompiledField) -> PointBatch:
    inputs, hidden = field.mlp.w1.shape
    return new_batch(field.geometry.levels, field.features.shape[1], inputs, hidden)


@kernel(fastmath=True)
def _forward(batch: PointBatch, field: CompiledField) -> None:
    levels = field.geometry.levels
    if levels > 0:
        locate(batch, field.geometry, field.vertices, field.features)
        interpolate(batch, levels, field.features)
    wave(batch, levels * field.features.shape[1], field.turns_per_m)
    forward(batch, field.mlp)


@kernel(fastmath=True)
def evaluate(points: Floats, field: CompiledField, logits: Floats, gradients: Floats) -> None:
    """Fill ``logits`` [N] and, where not empty, ``gradients`` [N, 3] (per metre)."""
    learnt = field.geometry.levels * field.features.shape[1]
    batch = _batch_for(field)
    batch.slopes[:] = 1
    w1_transposed, w2_transposed = transposed(field.mlp, len(batch.x))
    for first in range(0, len(points), BATCH):
        count = load(batch, points, first)
        _forward(batch, field)
        for t in range(count):
            logits[first + t] = batch.logits[t]
        if len(gradients) == 0:
            continue
        backward(batch, field.mlp, w1_transposed, w2_transposed)
        batch.gradient[:] = 0
        add_wave_slopes(batch, learnt, field.turns_per_m)
        if field.geometry.levels > 0:
            add_feature_slopes(batch, field.geometry, field.features)
        for t in range(count):
            for axis in range(3):
                gradients[first + t, axis] = batch.gradient[axis, t]


@kernel(fastmath=True)
def _record_touched(batch: PointBatch, count: int, touched: Touched, step: int, known: int) -> int:
    """Add the rows of the first ``count`` points to the ``known`` ones; returns how many now."""
    for t in range(count):
        for i in range(batch.rows.shape[1]):
            row = batch.rows[t, i]
            if touched.stamps[row] != step and row != 0:  # absent vertices learn nothing
                touched.stamps[row] = step
                touched.rows[known] = row
                known += 1
    return known


@kernel(fastmath=True)
def _cross_entropy(batch: PointBatch, targets: Floats, share: float) -> float:
    """Sets the slopes of the batch's logits; returns the sum of the losses."""
    loss = 0.0
    batch.slopes[:] = 0
    for t in range(len(targets)):
        logit = batch.logits[t]
        tail = np.exp(-abs(logit))  # never overflows
        squashed = (np.float32(1) if logit >= 0 else tail) / (np.float32(1) + tail)
        loss += max(logit, np.float32(0)) - logit * targets[t] + np.log1p(tail)
        batch.slopes[t] = (squashed - targets[t]) * np.float32(share)
    return loss


@kernel(fastmath=True)
def accumulate(
    points: Floats,
    targets: Floats,
    share: float,
    field: CompiledField,
    mlp_sums: Mlp,
    feature_sums: Floats,
    touched: Touched,
    step: int,
) -> tuple[int, float]:
    """Add the gradient of the cross entropy between ``targets`` [N] and the squashed logits.

    Args:
        points: [N, 3] metres from the region's centre.
        targets: [N] in [0, 1].
        share: weight of each sample.
        field: the field.
        mlp_sums: gradients of the MLP.
        feature_sums: gradients of the features, shaped as they; row 0 collects what is for
            vertices that do not exist.
        touched: the rows that a gradient was added to.
        step: differs from that of all other steps with the same ``touched``.

    Returns:
        How many rows were touched, and the sum of the samples' losses times ``share``.
    """
    levels = field.geometry.levels
    batch = _batch_for(field)
    w1_transposed, w2_transposed = transposed(field.mlp, levels * field.features.shape[1])
    known = 0
    loss = 0.0
    for first in range(0, len(points), BATCH):
        count = load(batch, points, first)
        _forward(batch, field)
        loss += _cross_entropy(batch, targets[first : first + count], share)
        backward(batch, field.mlp, w1_transposed, w2_transposed)
        add_weight_gradient(batch, mlp_sums)
        if levels > 0:
            add_feature_gradient(batch, count, levels, feature_sums)
            known = _record_touched(batch, count, touched, step, known)
    return known, float(loss * share)


class FieldArrays(NamedTuple):
    """The numbers of a field."""

    features: (
        Floats  # [rows, feature_size] by the rows of its tree; row 0, absent vertices, is zero
    )
    mlp: tuple[Floats, ...]  # weights [in, out] and bias [out] of each layer in turn
    frequencies: Floats  # [m] of Fourier features, on coordinates normalised to [-1, 1]


class FrozenCompiledField:
    """A field that answers from arrays, which nothing may change from then on."""

    def __init__(self, settings: FieldSettings, tree: FrozenQuadtree, arrays: FieldArrays) -> None:
        self.settings = settings
        self.tree = tree
        self.arrays = arrays
        self._field = make_field(settings, tree, arrays)

    def evaluate(self, points: Floats, gradient: bool) -> FieldValues:
        """The field at points [N, 3], metres from the region's centre; on the caller's thread."""
        logits = np.empty(len(points), np.float32)
        gradients = np.empty((len(points) if gradient else 0, 3), np.float32)
        evaluate(points, self._field, logits, gradients)
        scale = np.float32(self.settings.logit_scale_m)
        return FieldValues(logits * scale, gradients * scale)


def recorded_field(settings: FieldSettings, region: Region) -> FrozenCompiledField:
    """The field of a region as a file holds it."""
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
    return FrozenCompiledField(settings, tree.freeze(), arrays)


def make_field(
    settings: FieldSettings, tree: LiveQuadtree | FrozenQuadtree, arrays: FieldArrays
) -> CompiledField:
    """The form of a field that kernels take; it shares memory with the arrays and the tree."""
    geometry = Geometry(
        np.float32(settings.leaf_m),
        np.float32(1 << (settings.depth - 1)),
        settings.feature_levels if settings.encoding != "fourier" else 0,
        tree.shape,
    )
    w1, b1, w2, b2, w3, b3 = arrays.mlp
    turns = arrays.frequencies / np.float32(settings.region_side_m / 2)
    return CompiledField(
        geometry,
        tree.vertices,
        arrays.features,
        Mlp(w1, b1, w2, b2, w3.reshape(-1), b3),
        turns if settings.encoding != "features" else turns[:0],
    )
