"""The field's arithmetic in compiled code, for the CPU.

The same field as the tensors of :mod:`triquad_server.field` compute, which are its reference:
forward pass, gradient with respect to the point, gradient with respect to the parameters, and a
row-wise Adam step. A kernel runs on one thread and holds no Python lock; callers split the work.

Arrays are float32. Weights are stored transposed, ``[out, in]``, so that a layer is a row of dot
products. Fourier phases are counted in turns, not radians, which makes their reduction exact.
"""

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from triquad_format.region import AXES

from triquad_server.hash_table import EMPTY, MULTIPLIER
from triquad_server.quadtree import PLANE_BITS

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]

_SPREAD = (
    (16, 0x0000FFFF0000FFFF),
    (8, 0x00FF00FF00FF00FF),
    (4, 0x0F0F0F0F0F0F0F0F),
    (2, 0x3333333333333333),
    (1, 0x5555555555555555),
)
_AXES = np.array(AXES)
_TURN = 2 * np.pi


class Geometry(NamedTuple):
    """Numbers that place points among the vertices."""

    leaf_m: float
    half_side: float  # of the cube, in leaves
    levels: int  # H, or 0 where the field has no features
    block_limit: int  # blocks along the side of the cube


class Index(NamedTuple):
    """The block index of the three planes (see :mod:`triquad_server.quadtree`)."""

    keys: NDArray[np.int64]  # [slots]
    numbers: NDArray[np.int64]  # [slots]
    shift: int  # of the hash
    rows: Ints  # [blocks, vertices of a block]
    starts: NDArray[np.int64]  # [H] first vertex of each level within a block


class Decoder(NamedTuple):
    """The MLP, transposed, and the Fourier frequencies."""

    w1: Floats  # [hidden, input]
    b1: Floats
    w2: Floats  # [hidden, hidden]
    b2: Floats
    w3: Floats  # [hidden]
    b3: Floats  # [1]
    turns_per_m: Floats  # [m], empty where the field has no Fourier features


@numba.njit(cache=True, nogil=True, inline="always")
def _spread(bits: int) -> int:
    for shift, mask in _SPREAD:
        bits = (bits | (bits << shift)) & mask
    return bits


class Scratch(NamedTuple):
    """Room for what a kernel works out of one point."""

    rows: Ints  # [12 H] feature rows of the vertices around
    weights: Floats  # [12 H]
    slopes: Floats  # [12 H, 2] derivatives of the weights, per metre
    turns: Floats  # [6 m] phases of the Fourier features
    x: Floats  # [input] of the MLP
    gx: Floats  # [input] its gradient
    h1: Floats  # [hidden] first layer
    h2: Floats  # [hidden] second layer
    g1: Floats  # [hidden] gradient before the ReLU of the first layer
    g2: Floats  # [hidden] and of the second


@numba.njit(cache=True, nogil=True)
def _scratch(geometry: Geometry, decoder: Decoder) -> Scratch:
    around = 12 * geometry.levels
    hidden, inputs = decoder.w1.shape
    return Scratch(
        np.zeros(around, np.int32),
        np.zeros(around, np.float32),
        np.zeros((around, 2), np.float32),
        np.zeros(6 * len(decoder.turns_per_m), np.float32),
        np.zeros(inputs, np.float32),
        np.zeros(inputs, np.float32),
        np.zeros(hidden, np.float32),
        np.zeros(hidden, np.float32),
        np.zeros(hidden, np.float32),
        np.zeros(hidden, np.float32),
    )


@numba.njit(cache=True, nogil=True)
def _find_block(index: Index, key: int) -> int:
    mask = len(index.keys) - 1
    slot = ((key * MULTIPLIER) >> index.shift) & mask
    while index.keys[slot] != EMPTY:
        if index.keys[slot] == key:
            return int(index.numbers[slot])
        slot = (slot + 1) & mask
    return 0


@numba.njit(cache=True, nogil=True, fastmath=True, inline="always")
def _add_row(out: Floats, start: int, scale: float, table: Floats, row: int) -> None:
    """``out[start:] += scale * table[row]``; a row of 8 is one vector instruction."""
    if table.shape[1] == 8:
        for k in range(8):
            out[start + k] += scale * table[row, k]
    else:
        for k in range(table.shape[1]):
            out[start + k] += scale * table[row, k]


@numba.njit(cache=True, nogil=True, fastmath=True, inline="always")
def _add_to_row(table: Floats, row: int, scale: float, values: Floats, start: int) -> None:
    """``table[row] += scale * values[start:]``."""
    if table.shape[1] == 8:
        for k in range(8):
            table[row, k] += scale * values[start + k]
    else:
        for k in range(table.shape[1]):
            table[row, k] += scale * values[start + k]


@numba.njit(cache=True, nogil=True, fastmath=True, inline="always")
def _dot_row(values: Floats, start: int, table: Floats, row: int) -> float:
    """``values[start:] @ table[row]``."""
    total: float = np.float32(0)
    if table.shape[1] == 8:
        for k in range(8):
            total += values[start + k] * table[row, k]
    else:
        for k in range(table.shape[1]):
            total += values[start + k] * table[row, k]
    return total


@numba.njit(cache=True, nogil=True)
def _cosine(turns: Floats, cosines: Floats) -> None:
    """Cosines of angles in turns; a polynomial, which compiles to vector instructions."""
    for i in range(len(turns)):
        t = turns[i] - np.floor(turns[i] + np.float32(0.5))
        u = np.float32(0.25) - abs(t)
        v = u * u
        p = np.float32(-15.094643)
        p = p * v + np.float32(42.058693)
        p = p * v + np.float32(-76.705860)
        p = p * v + np.float32(81.605249)
        p = p * v + np.float32(-41.341702)
        p = p * v + np.float32(6.2831853)
        cosines[i] = p * u


@numba.njit(cache=True, nogil=True, fastmath=True)
def _locate(
    point: Floats,
    geometry: Geometry,
    index: Index,
    rows: Ints,
    weights: Floats,
    slopes: Floats,
) -> None:
    """Rows [36], weights [36] and weight derivatives [36, 2] (per metre) of the vertices around."""
    levels = geometry.levels
    scale = 1 << (levels - 1)
    at = 0
    for plane in range(3):
        u = point[_AXES[plane, 0]] / geometry.leaf_m + geometry.half_side
        v = point[_AXES[plane, 1]] / geometry.leaf_m + geometry.half_side
        u /= scale
        v /= scale
        block_u = int(np.floor(u))
        block_v = int(np.floor(v))
        number = 0
        if min(block_u, block_v) >= 0 and max(block_u, block_v) < geometry.block_limit:
            key = _spread(block_u) | (_spread(block_v) << 1) | (plane << PLANE_BITS)
            number = _find_block(index, key)
        u -= np.float32(block_u)
        v -= np.float32(block_v)
        for h in range(levels):
            cells = 1 << h
            cell_u = int(u * cells)
            cell_v = int(v * cells)
            a = u * cells - np.float32(cell_u)
            b = v * cells - np.float32(cell_v)
            first = index.starts[h] + cell_u * (cells + 1) + cell_v
            rows[at] = index.rows[number, first]
            rows[at + 1] = index.rows[number, first + cells + 1]
            rows[at + 2] = index.rows[number, first + 1]
            rows[at + 3] = index.rows[number, first + cells + 2]
            weights[at] = (1 - a) * (1 - b)
            weights[at + 1] = a * (1 - b)
            weights[at + 2] = (1 - a) * b
            weights[at + 3] = a * b
            per_m = np.float32(cells / (scale * geometry.leaf_m))
            slopes[at, 0] = -(1 - b) * per_m
            slopes[at, 1] = -(1 - a) * per_m
            slopes[at + 1, 0] = (1 - b) * per_m
            slopes[at + 1, 1] = -a * per_m
            slopes[at + 2, 0] = -b * per_m
            slopes[at + 2, 1] = (1 - a) * per_m
            slopes[at + 3, 0] = b * per_m
            slopes[at + 3, 1] = a * per_m
            at += 4


@numba.njit(cache=True, nogil=True, fastmath=True)
def _encode(
    point: Floats,
    features: Floats,
    geometry: Geometry,
    decoder: Decoder,
    rows: Ints,
    weights: Floats,
    turns: Floats,
    x: Floats,
) -> None:
    """The MLP's input ``x`` for a point, from the vertices that :func:`_locate` found."""
    size = features.shape[1]
    levels = geometry.levels
    for k in range(levels * size):
        x[k] = 0
    for at in range(12 * levels):
        row = rows[at]
        if row == 0:
            continue
        _add_row(x, ((at >> 2) % levels) * size, weights[at], features, row)
    m = len(decoder.turns_per_m)
    for axis in range(3):
        for i in range(m):
            turns[axis * m + i] = point[axis] * decoder.turns_per_m[i] - np.float32(0.25)
            turns[(3 + axis) * m + i] = point[axis] * decoder.turns_per_m[i]
    _cosine(turns, x[levels * size :])


@numba.njit(cache=True, nogil=True, fastmath=True)
def _decode(x: Floats, decoder: Decoder, h1: Floats, h2: Floats) -> float:
    """The logit; leaves both hidden layers after their ReLU."""
    for j in range(len(h1)):
        total = decoder.b1[j]
        for k in range(len(x)):
            total += decoder.w1[j, k] * x[k]
        h1[j] = max(total, np.float32(0))
    logit: float = decoder.b3[0]
    for j in range(len(h2)):
        total = decoder.b2[j]
        for k in range(len(h1)):
            total += decoder.w2[j, k] * h1[k]
        h2[j] = max(total, np.float32(0))
        logit += decoder.w3[j] * h2[j]
    return logit


@numba.njit(cache=True, nogil=True, fastmath=True)
def _backward_hidden(
    slope: float, decoder: Decoder, h1: Floats, h2: Floats, g1: Floats, g2: Floats
) -> None:
    """Gradients before the ReLUs of both hidden layers, for a gradient ``slope`` of the logit."""
    for k in range(len(h1)):
        g1[k] = 0
    for j in range(len(h2)):
        g2[j] = 0
        if h2[j] > 0:
            g2[j] = slope * decoder.w3[j]
            for k in range(len(h1)):
                g1[k] += g2[j] * decoder.w2[j, k]
    for k in range(len(h1)):
        if h1[k] <= 0:
            g1[k] = 0


@numba.njit(cache=True, nogil=True, fastmath=True)
def _backward_input(g1: Floats, decoder: Decoder, count: int, gx: Floats) -> None:
    """Gradient of the first ``count`` inputs."""
    for k in range(count):
        gx[k] = 0
    for j in range(len(g1)):
        if g1[j] != 0:
            for k in range(count):
                gx[k] += g1[j] * decoder.w1[j, k]


@numba.njit(cache=True, nogil=True, fastmath=True)
def evaluate(
    points: Floats,
    features: Floats,
    geometry: Geometry,
    index: Index,
    decoder: Decoder,
    logits: Floats,
    gradients: Floats,
) -> None:
    """Fill ``logits`` [N] and, where not empty, ``gradients`` [N, 3] (per metre)."""
    size = features.shape[1]
    inputs = decoder.w1.shape[1]
    around = 12 * geometry.levels
    rows, weights, slopes, turns, x, gx, h1, h2, g1, g2 = _scratch(geometry, decoder)
    for i in range(len(points)):
        if geometry.levels > 0:
            _locate(points[i], geometry, index, rows, weights, slopes)
        _encode(points[i], features, geometry, decoder, rows, weights, turns, x)
        logits[i] = _decode(x, decoder, h1, h2)
        if len(gradients) == 0:
            continue
        _backward_hidden(np.float32(1), decoder, h1, h2, g1, g2)
        _backward_input(g1, decoder, inputs, gx)
        gradient = gradients[i]
        gradient[:] = 0
        for at in range(around):
            row = rows[at]
            if row == 0:
                continue
            along = _dot_row(gx, ((at >> 2) % geometry.levels) * size, features, row)
            plane = at // (4 * geometry.levels)
            gradient[_AXES[plane, 0]] += along * slopes[at, 0]
            gradient[_AXES[plane, 1]] += along * slopes[at, 1]
        m = len(decoder.turns_per_m)
        first = geometry.levels * size
        for axis in range(3):
            total = np.float32(0)
            for k in range(m):
                sine, cosine = first + axis * m + k, first + (3 + axis) * m + k
                total += decoder.turns_per_m[k] * (gx[sine] * x[cosine] - gx[cosine] * x[sine])
            gradient[axis] += np.float32(_TURN) * total


@numba.njit(cache=True, nogil=True, fastmath=True)
def accumulate(
    points: Floats,
    targets: Floats,
    share: float,
    features: Floats,
    geometry: Geometry,
    index: Index,
    decoder: Decoder,
    sums: Decoder,
    feature_sums: Floats,
    touched: NDArray[np.uint8],
) -> float:
    """Add the gradient of the cross entropy between ``targets`` [N] and the squashed logits.

    Args:
        points: [N, 3] metres from the region's centre.
        targets: [N] in [0, 1].
        share: weight of each sample.
        features, geometry, index, decoder: the field.
        sums: gradients of the decoder, shaped as it.
        feature_sums: gradients of the features, shaped as they.
        touched: [rows] set to 1 where a gradient was added.

    Returns:
        The sum of the samples' losses times ``share``.
    """
    size = features.shape[1]
    inputs, hidden = decoder.w1.shape[1], decoder.w1.shape[0]
    around = 12 * geometry.levels
    learnt = geometry.levels * size
    rows, weights, slopes, turns, x, gx, h1, h2, g1, g2 = _scratch(geometry, decoder)
    loss = 0.0
    for i in range(len(points)):
        if geometry.levels > 0:
            _locate(points[i], geometry, index, rows, weights, slopes)
        _encode(points[i], features, geometry, decoder, rows, weights, turns, x)
        logit = _decode(x, decoder, h1, h2)
        tail = np.exp(-abs(logit))  # never overflows
        squashed = (np.float32(1) if logit >= 0 else tail) / (1 + tail)
        loss += max(logit, np.float32(0)) - logit * targets[i] + np.log1p(tail)
        slope = np.float32((squashed - targets[i]) * share)
        _backward_hidden(slope, decoder, h1, h2, g1, g2)
        sums.b3[0] += slope
        for j in range(hidden):
            sums.w3[j] += slope * h2[j]
            if g2[j] != 0:
                sums.b2[j] += g2[j]
                for k in range(hidden):
                    sums.w2[j, k] += g2[j] * h1[k]
            if g1[j] != 0:
                sums.b1[j] += g1[j]
                for k in range(inputs):
                    sums.w1[j, k] += g1[j] * x[k]
        _backward_input(g1, decoder, learnt, gx)
        for at in range(around):
            row = rows[at]
            if row == 0:
                continue
            touched[row] = 1
            start = ((at >> 2) % geometry.levels) * size
            _add_to_row(feature_sums, row, weights[at], gx, start)
    return float(loss * share)
