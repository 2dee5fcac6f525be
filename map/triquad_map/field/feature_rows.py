"""Rows of a feature table, as kernels read and write them.

A row of 8 numbers is one vector of the processor. The compiler does not find that out by itself
where a loop over a row reads one array and writes another that might be the same; rows of another
length are loops.
"""

import numpy as np
from triquad_format.records.arrays import Floats

from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.lanes import LANES, fill, load, root, store, total


@kernel(fastmath=True, inline="always")
def add_rows(
    out: Floats,
    point: int,
    start: int,
    table: Floats,
    rows: tuple[int, int, int, int],
    weights: tuple[float, float, float, float],
) -> None:
    """``out[point, start:start + size] += weights @ table[rows]``; ``weights`` are float32."""
    if table.shape[1] == LANES:
        first, second = load(table, (rows[0], 0)), load(table, (rows[1], 0))
        third, fourth = load(table, (rows[2], 0)), load(table, (rows[3], 0))
        low = fill(weights[0]) * first + fill(weights[1]) * second
        high = fill(weights[2]) * third + fill(weights[3]) * fourth
        store(out, (point, start), load(out, (point, start)) + low + high)
    else:
        for corner in range(4):
            for k in range(table.shape[1]):
                out[point, start + k] += weights[corner] * table[rows[corner], k]


@kernel(fastmath=True, inline="always")
def add_to_row(
    table: Floats, row: int, weight: float, values: Floats, point: int, start: int
) -> None:
    """``table[row] += weight * values[point, start:start + size]``; ``weight`` is a float32."""
    if table.shape[1] == LANES:
        added = fill(weight) * load(values, (point, start))
        store(table, (row, 0), load(table, (row, 0)) + added)
    else:
        for k in range(table.shape[1]):
            table[row, k] += weight * values[point, start + k]


@kernel(fastmath=True, inline="always")
def row_slopes(
    values: Floats,
    point: int,
    start: int,
    table: Floats,
    rows: tuple[int, int, int, int],
    place: tuple[float, float],
) -> tuple[float, float]:
    """Return how ``values[point, start:start + size] @ row`` changes across and along a cell.

    The row is interpolated between those of the cell's corners, in the order of
    :class:`triquad_map.field.encoding.PointBatch`, at a ``place`` in it, float32.
    """
    if table.shape[1] == LANES:
        corner, right = load(table, (rows[0], 0)), load(table, (rows[1], 0))
        across, along = right - corner, load(table, (rows[2], 0)) - corner
        twist = load(table, (rows[3], 0)) - right - along
        value = load(values, (point, start))
        slopes = (
            total(value * (across + fill(place[1]) * twist)),
            total(value * (along + fill(place[0]) * twist)),
        )
    else:
        slopes = (np.float32(0), np.float32(0))
        for k in range(table.shape[1]):
            of_corner, of_right = table[rows[0], k], table[rows[1], k]
            of_across, of_along = of_right - of_corner, table[rows[2], k] - of_corner
            of_twist = table[rows[3], k] - of_right - of_along
            of_value = values[point, start + k]
            slopes = (
                slopes[0] + of_value * (of_across + place[1] * of_twist),
                slopes[1] + of_value * (of_along + place[0] * of_twist),
            )
    return slopes


@kernel(fastmath=True, inline="always")
def move_row(
    gradients: Floats,
    values: Floats,
    means: Floats,
    variances: Floats,
    row: int,
    blends: tuple[float, float],
    scales: tuple[float, float],
    epsilon: float,
) -> None:
    """Do a step of Adam, as in :mod:`triquad_server.engine.compiled_trainer`; clears the gradient.

    Numbers are float32.

    Args:
        gradients, values, means, variances: tables of the same shape.
        row: which.
        blends: how much of the mean, and of the variance, the new gradient makes up.
        scales: the learning rate times the correction of the mean, and that of the variance.
        epsilon: keeps the division finite.
    """
    if values.shape[1] == LANES:
        gradient, mean, variance = (
            load(gradients, (row, 0)),
            load(means, (row, 0)),
            load(variances, (row, 0)),
        )
        mean = mean + fill(blends[0]) * (gradient - mean)
        variance = variance + fill(blends[1]) * (gradient * gradient - variance)
        deviation = root(variance * fill(scales[1])) + fill(epsilon)
        value = load(values, (row, 0)) - fill(scales[0]) * mean / deviation
        store(gradients, (row, 0), fill(np.float32(0)))
        store(means, (row, 0), mean)
        store(variances, (row, 0), variance)
        store(values, (row, 0), value)
    else:
        for k in range(values.shape[1]):
            gradient = gradients[row, k]
            gradients[row, k] = 0
            means[row, k] += blends[0] * (gradient - means[row, k])
            variances[row, k] += blends[1] * (gradient * gradient - variances[row, k])
            deviation = np.sqrt(variances[row, k] * scales[1]) + epsilon
            values[row, k] -= scales[0] * means[row, k] / deviation
