"""The field's arithmetic in compiled code, for the CPU.

The same field as the tensors of :mod:`triquad_server.engine.field` compute, which are its
reference: values, gradients with respect to the points and to the parameters. A kernel
runs on one thread and holds no Python lock; callers split the work. Arrays are float32.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from triquad_map.compiled.field.batch import TILE, Tile, load, new_tile
from triquad_map.compiled.field.encoding import (
    Geometry,
    add_feature_gradient,
    add_feature_slopes,
    add_wave_slopes,
    interpolate,
    locate,
    wave,
)
from triquad_map.compiled.field.mlp import Mlp, add_weight_gradient, backward, forward, turned
from triquad_map.compiled.field.quadtree import Vertices
from triquad_map.compiled.kernel import kernel

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]


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
def _tile_for(field: CompiledField) -> Tile:
    inputs, hidden = field.mlp.w1.shape
    return new_tile(field.geometry.levels, field.features.shape[1], inputs, hidden)


@kernel(fastmath=True)
def _forward(tile: Tile, field: CompiledField) -> None:
    levels = field.geometry.levels
    if levels > 0:
        locate(tile, field.geometry, field.vertices, field.features)
        interpolate(tile, levels, field.features)
    wave(tile, levels * field.features.shape[1], field.turns_per_m)
    forward(tile, field.mlp)


@kernel(fastmath=True)
def evaluate(points: Floats, field: CompiledField, logits: Floats, gradients: Floats) -> None:
    """Fill ``logits`` [N] and, where not empty, ``gradients`` [N, 3] (per metre)."""
    learnt = field.geometry.levels * field.features.shape[1]
    tile = _tile_for(field)
    tile.slopes[:] = 1
    w1_turned, w2_turned = turned(field.mlp, len(tile.x))
    for first in range(0, len(points), TILE):
        count = load(tile, points, first)
        _forward(tile, field)
        for t in range(count):
            logits[first + t] = tile.logits[t]
        if len(gradients) == 0:
            continue
        backward(tile, field.mlp, w1_turned, w2_turned)
        tile.gradient[:] = 0
        add_wave_slopes(tile, learnt, field.turns_per_m)
        if field.geometry.levels > 0:
            add_feature_slopes(tile, field.geometry, field.features)
        for t in range(count):
            for axis in range(3):
                gradients[first + t, axis] = tile.gradient[axis, t]


@kernel(fastmath=True)
def _note_touched(tile: Tile, count: int, touched: Touched, step: int, known: int) -> int:
    """Add the rows of the first ``count`` points to the ``known`` ones; returns how many now."""
    for t in range(count):
        for i in range(tile.rows.shape[1]):
            row = tile.rows[t, i]
            if touched.stamps[row] != step and row != 0:  # absent vertices learn nothing
                touched.stamps[row] = step
                touched.rows[known] = row
                known += 1
    return known


@kernel(fastmath=True)
def _cross_entropy(tile: Tile, targets: Floats, share: float) -> float:
    """Sets the slopes of the tile's logits; returns the sum of the losses."""
    loss = 0.0
    tile.slopes[:] = 0
    for t in range(len(targets)):
        logit = tile.logits[t]
        tail = np.exp(-abs(logit))  # never overflows
        squashed = (np.float32(1) if logit >= 0 else tail) / (np.float32(1) + tail)
        loss += max(logit, np.float32(0)) - logit * targets[t] + np.log1p(tail)
        tile.slopes[t] = (squashed - targets[t]) * np.float32(share)
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
    tile = _tile_for(field)
    w1_turned, w2_turned = turned(field.mlp, levels * field.features.shape[1])
    known = 0
    loss = 0.0
    for first in range(0, len(points), TILE):
        count = load(tile, points, first)
        _forward(tile, field)
        loss += _cross_entropy(tile, targets[first : first + count], share)
        backward(tile, field.mlp, w1_turned, w2_turned)
        add_weight_gradient(tile, mlp_sums)
        if levels > 0:
            add_feature_gradient(tile, count, levels, feature_sums)
            known = _note_touched(tile, count, touched, step, known)
    return known, float(loss * share)
