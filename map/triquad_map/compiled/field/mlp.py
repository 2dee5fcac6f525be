"""The field's MLP on a batch in compiled code: forward, and backward by hand."""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Floats

from triquad_map.compiled.field.encoding import BATCH, PointBatch
from triquad_map.compiled.kernel import kernel

_ZERO = np.float32(0)


class Mlp(NamedTuple):
    """Weights of the MLP, or gradients of them."""

    w1: Floats  # [input, hidden]
    b1: Floats  # [hidden]
    w2: Floats  # [hidden, hidden]
    b2: Floats  # [hidden]
    w3: Floats  # [hidden]
    b3: Floats  # [1]


@kernel(fastmath=True)
def _add_product(weights: Floats, x: Floats, out: Floats) -> None:
    """``out += weights.T @ x`` for weights [K, J], x [K, T], out [J, T]."""
    inputs, outputs = weights.shape
    k = 0
    while k + 8 <= inputs:  # so many at once that reading and writing ``out`` costs little
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


@kernel(fastmath=True)
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


@kernel(fastmath=True)
def _dot(a: Floats, b: Floats) -> float:
    total: float = _ZERO
    for t in range(BATCH):
        total += a[t] * b[t]
    return total


@kernel(fastmath=True)
def _add_row_sums(g: Floats, sums: Floats) -> None:
    """``sums += g.sum(1)`` for g [J, T]."""
    for j in range(len(g)):
        total = _ZERO
        for t in range(BATCH):
            total += g[j, t]
        sums[j] += total


@kernel(fastmath=True)
def _layer(weights: Floats, biases: Floats, x: Floats, out: Floats) -> None:
    for j in range(len(biases)):
        for t in range(BATCH):
            out[j, t] = biases[j]
    _add_product(weights, x, out)
    for j in range(len(biases)):
        for t in range(BATCH):
            out[j, t] = max(out[j, t], _ZERO)


@kernel(fastmath=True)
def forward(batch: PointBatch, mlp: Mlp) -> None:
    """Both hidden layers and the logits of the batch's inputs."""
    _layer(mlp.w1, mlp.b1, batch.x, batch.h1)
    _layer(mlp.w2, mlp.b2, batch.h1, batch.h2)
    for t in range(BATCH):
        batch.logits[t] = mlp.b3[0]
    for j in range(len(mlp.w3)):
        for t in range(BATCH):
            batch.logits[t] += mlp.w3[j] * batch.h2[j, t]


@kernel()
def transposed(mlp: Mlp, inputs: int) -> tuple[Floats, Floats]:
    """The first two layers' weights as :func:`backward` needs them.

    Those of the first layer reach the first ``inputs`` inputs only.
    """
    return np.ascontiguousarray(mlp.w1[:inputs].T), np.ascontiguousarray(mlp.w2.T)


@kernel(fastmath=True)
def backward(batch: PointBatch, mlp: Mlp, w1_transposed: Floats, w2_transposed: Floats) -> None:
    """Gradients of the hidden layers and of the inputs, from ``batch.slopes``."""
    for j in range(len(mlp.w3)):
        for t in range(BATCH):
            batch.g2[j, t] = batch.slopes[t] * mlp.w3[j] if batch.h2[j, t] > 0 else _ZERO
    batch.g1[:] = 0
    _add_product(w2_transposed, batch.g2, batch.g1)
    for j in range(len(mlp.b1)):
        for t in range(BATCH):
            batch.g1[j, t] = batch.g1[j, t] if batch.h1[j, t] > 0 else _ZERO
    gx = batch.gx[: w1_transposed.shape[1]]
    gx[:] = 0
    _add_product(w1_transposed, batch.g1, gx)


@kernel(fastmath=True)
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
