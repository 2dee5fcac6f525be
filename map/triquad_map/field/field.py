"""The field's arithmetic in compiled code: encoding, MLP, and backward through both by hand.

The same field as the tensors of :mod:`triquad_server.engine.tensor_field` compute, which are its
reference. A kernel runs on one thread and without Python's lock; callers split the work. Arrays are
float32.
"""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Floats
from triquad_format.records.field_settings import FieldSettings

from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.field.encoding import (
    BATCH,
    Geometry,
    PointBatch,
    add_feature_slopes,
    add_wave_slopes,
    interpolate,
    load,
    locate,
    new_batch,
    wave,
)
from triquad_map.field.quadtree import FrozenQuadtree, LiveQuadtree, Vertices

_ZERO = np.float32(0)


class Mlp(NamedTuple):
    """Weights of the MLP, or gradients of them."""

    w1: Floats  # [input, hidden]
    b1: Floats  # [hidden]
    w2: Floats  # [hidden, hidden]
    b2: Floats  # [hidden]
    w3: Floats  # [hidden]
    b3: Floats  # [1]


class CompiledField(NamedTuple):
    """A field as kernels take it."""

    geometry: Geometry
    vertices: Vertices
    features: Floats  # [rows, d]
    mlp: Mlp
    turns_per_m: Floats  # [m] Fourier frequencies, empty where the field has none


class FieldArrays(NamedTuple):
    """The numbers of a field."""

    features: Floats  # [rows of the tree, feature_size]; row 0 is zero: absent vertices
    mlp: tuple[Floats, ...]  # weights [in, out] and bias [out] of each layer in turn
    frequencies: Floats  # [m] of Fourier features, on coordinates normalised to [-1, 1]


@inner_kernel(fastmath=True)
def add_product(weights: Floats, x: Floats, out: Floats) -> None:
    """``out += weights.T @ x`` for weights [K, J], x [K, T], out [J, T]."""
    inputs, outputs = weights.shape
    k = 0
    while k + 8 <= inputs:  # enough at once that reading and writing ``out`` costs little
        for j in range(outputs):
            w0, w1, w2, w3 = weights[k, j], weights[k + 1, j], weights[k + 2, j], weights[k + 3, j]
            w4, w5 = weights[k + 4, j], weights[k + 5, j]
            w6, w7 = weights[k + 6, j], weights[k + 7, j]
            for t in range(BATCH):
                out[j, t] += (
                    w0 * x[k, t]
                    + w1 * x[k + 1, t]
                    + w2 * x[k + 2, t]
                    + w3 * x[k + 3, t]
                    + w4 * x[k + 4, t]
                    + w5 * x[k + 5, t]
                    + w6 * x[k + 6, t]
                    + w7 * x[k + 7, t]
                )
        k += 8
    while k < inputs:
        for j in range(outputs):
            for t in range(BATCH):
                out[j, t] += weights[k, j] * x[k, t]
        k += 1


@inner_kernel(fastmath=True)
def _add_outer_product(x: Floats, g: Floats, sums: Floats) -> None:
    """``sums += x @ g.T`` for x [K, T], g [J, T], sums [K, J]."""
    inputs, outputs = sums.shape
    even, fourth = inputs - inputs % 2, outputs - outputs % 4
    for k in range(0, even, 2):  # 2 rows by 4, so that what is read serves several products
        for j in range(0, fourth, 4):
            s0, s1, s2, s3 = _ZERO, _ZERO, _ZERO, _ZERO
            t0, t1, t2, t3 = _ZERO, _ZERO, _ZERO, _ZERO
            for t in range(BATCH):
                s0 += x[k, t] * g[j, t]
                s1 += x[k, t] * g[j + 1, t]
                s2 += x[k, t] * g[j + 2, t]
                s3 += x[k, t] * g[j + 3, t]
                t0 += x[k + 1, t] * g[j, t]
                t1 += x[k + 1, t] * g[j + 1, t]
                t2 += x[k + 1, t] * g[j + 2, t]
                t3 += x[k + 1, t] * g[j + 3, t]
            sums[k, j] += s0
            sums[k, j + 1] += s1
            sums[k, j + 2] += s2
            sums[k, j + 3] += s3
            sums[k + 1, j] += t0
            sums[k + 1, j + 1] += t1
            sums[k + 1, j + 2] += t2
            sums[k + 1, j + 3] += t3
    for k in range(inputs):
        for j in range(fourth if k < even else 0, outputs):
            sums[k, j] += _dot(x[k], g[j])


@inner_kernel(fastmath=True)
def _dot(a: Floats, b: Floats) -> float:
    total: float = _ZERO
    for t in range(BATCH):
        total += a[t] * b[t]
    return total


@inner_kernel(fastmath=True)
def _add_row_sums(g: Floats, sums: Floats) -> None:
    """``sums += g.sum(1)`` for g [J, T]."""
    for j in range(len(g)):
        total = _ZERO
        for t in range(BATCH):
            total += g[j, t]
        sums[j] += total


@inner_kernel(fastmath=True)
def _layer(weights: Floats, biases: Floats, x: Floats, out: Floats) -> None:
    for j in range(len(biases)):
        for t in range(BATCH):
            out[j, t] = biases[j]
    add_product(weights, x, out)
    for j in range(len(biases)):
        for t in range(BATCH):
            out[j, t] = max(out[j, t], _ZERO)


@inner_kernel(fastmath=True)
def _decode(batch: PointBatch, mlp: Mlp) -> None:
    """Compute both hidden layers and the logits of the batch's inputs."""
    _layer(mlp.w1, mlp.b1, batch.x, batch.h1)
    decode_rest(batch, mlp)


@inner_kernel(fastmath=True)
def decode_rest(batch: PointBatch, mlp: Mlp) -> None:
    """Compute the second hidden layer and the logits, from the first."""
    _layer(mlp.w2, mlp.b2, batch.h1, batch.h2)
    for t in range(BATCH):
        batch.logits[t] = mlp.b3[0]
    for j in range(len(mlp.w3)):
        for t in range(BATCH):
            batch.logits[t] += mlp.w3[j] * batch.h2[j, t]


@inner_kernel()
def transposed(mlp: Mlp, inputs: int) -> tuple[Floats, Floats]:
    """Return the first two layers' weights as :func:`backward` needs them.

    Those of the first layer reach the first ``inputs`` inputs only.
    """
    return np.ascontiguousarray(mlp.w1[:inputs].T), np.ascontiguousarray(mlp.w2.T)


@kernel(fastmath=True)
def backward(batch: PointBatch, mlp: Mlp, w1_transposed: Floats, w2_transposed: Floats) -> None:
    """Compute gradients of the hidden layers and of the inputs, from ``batch.slopes``."""
    for j in range(len(mlp.w3)):
        for t in range(BATCH):
            batch.g2[j, t] = batch.slopes[t] * mlp.w3[j] if batch.h2[j, t] > 0 else _ZERO
    batch.g1[:] = 0
    add_product(w2_transposed, batch.g2, batch.g1)
    for j in range(len(mlp.b1)):
        for t in range(BATCH):
            batch.g1[j, t] = batch.g1[j, t] if batch.h1[j, t] > 0 else _ZERO
    gx = batch.gx[: w1_transposed.shape[1]]
    gx[:] = 0
    add_product(w1_transposed, batch.g1, gx)


@inner_kernel(fastmath=True)
def add_weight_gradient(batch: PointBatch, sums: Mlp) -> None:
    """Add the gradient of the weights, after :func:`backward`; points of no slope add nothing."""
    _add_outer_product(batch.x, batch.g1, sums.w1)
    _add_row_sums(batch.g1, sums.b1)
    _add_outer_product(batch.h1, batch.g2, sums.w2)
    _add_row_sums(batch.g2, sums.b2)
    for j in range(len(sums.w3)):
        sums.w3[j] += _dot(batch.slopes, batch.h2[j])
    for t in range(BATCH):
        sums.b3[0] += batch.slopes[t]


@inner_kernel()
def batch_for(field: CompiledField) -> PointBatch:
    """Return room for a batch of points of a field."""
    inputs, hidden = field.mlp.w1.shape
    return new_batch(field.geometry.levels, field.features.shape[1], inputs, hidden)


@kernel(fastmath=True)
def forward(batch: PointBatch, field: CompiledField) -> None:
    """Compute the logits of a batch, and what :func:`backward` needs of the layers before."""
    levels = field.geometry.levels
    if levels > 0:
        locate(batch, field.geometry, field.vertices, field.features)
        interpolate(batch, levels, field.features)
    wave(batch, levels * field.features.shape[1], field.turns_per_m)
    _decode(batch, field.mlp)


@kernel(fastmath=True)
def evaluate(points: Floats, field: CompiledField, logits: Floats, gradients: Floats) -> None:
    """Fill ``logits`` [N] and, where not empty, ``gradients`` [N, 3] (per metre)."""
    learnt = field.geometry.levels * field.features.shape[1]
    batch = batch_for(field)
    batch.slopes[:] = 1
    w1_transposed, w2_transposed = transposed(field.mlp, len(batch.x))
    for first in range(0, len(points), BATCH):
        count = load(batch, points, first)
        forward(batch, field)
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


def make_field(
    settings: FieldSettings, tree: LiveQuadtree | FrozenQuadtree, arrays: FieldArrays
) -> CompiledField:
    """Return the form of a field that kernels take; it shares memory with arrays and tree."""
    geometry = Geometry(
        leaf_m=np.float32(settings.leaf_m),
        half_side=np.float32(1 << (settings.depth - 1)),
        levels=settings.feature_levels if settings.encoding != "fourier" else 0,
        shape=tree.shape,
    )
    w1, b1, w2, b2, w3, b3 = arrays.mlp
    turns = arrays.frequencies / np.float32(settings.region_side_m / 2)
    return CompiledField(
        geometry=geometry,
        vertices=tree.vertices,
        features=arrays.features,
        mlp=Mlp(w1, b1, w2, b2, w3.reshape(-1), b3),
        turns_per_m=turns if settings.encoding != "features" else turns[:0],
    )
