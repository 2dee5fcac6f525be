"""Adam in compiled code: the step of :mod:`triquad_server.engine.adam`, on the touched rows."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_map.compiled.field.feature_rows import move_row, prefetch_row
from triquad_map.compiled.field.field import Touched
from triquad_map.compiled.kernel import kernel

from triquad_server.engine.adam import EPSILON, Betas

Floats = NDArray[np.float32]

_NEGLIGIBLE = 1e-8
_MAX_CORRECTED = 1 << 20
_AHEAD = 12  # rows that are brought into the cache before their turn


class Moments(NamedTuple):
    """Rows of values with their optimiser state."""

    values: Floats  # [rows, size]
    means: Floats  # [rows, size]
    variances: Floats  # [rows, size]
    steps: NDArray[np.int32]  # [rows]


class Rates(NamedTuple):
    """How far a step goes."""

    rate: float  # learning rate
    beta1: float
    beta2: float
    mean_scales: Floats  # [n] correction of the mean after 1, 2, ... steps; the last for more
    variance_scales: Floats  # [n] and of the variance


def rates(rate: float, betas: Betas) -> Rates:
    """The numbers of a step."""
    return Rates(rate, betas.mean, betas.variance, *_corrections(betas))


@lru_cache(maxsize=4)
def _corrections(betas: Betas) -> tuple[Floats, Floats]:
    """Scales of mean and variance by age, tabulated until they no longer matter."""
    slowest = max(betas.mean, betas.variance)
    count = min(_MAX_CORRECTED, 1 + int(np.log(_NEGLIGIBLE) / np.log(slowest)))
    ages = np.arange(1, count + 1)
    return (
        (1 / (1 - betas.mean**ages)).astype(np.float32),
        (1 / (1 - betas.variance**ages)).astype(np.float32),
    )


@kernel(fastmath=True, error_model="numpy", inline="always")
def step_row(row: int, gradients: Floats, moments: Moments, rates: Rates) -> None:
    """One step of a row along its gradient, which is cleared."""
    moments.steps[row] += 1
    age = min(moments.steps[row], len(rates.mean_scales)) - 1
    move_row(
        gradients,
        moments.values,
        moments.means,
        moments.variances,
        row,
        (np.float32(1 - rates.beta1), np.float32(1 - rates.beta2)),
        (np.float32(rates.rate) * rates.mean_scales[age], rates.variance_scales[age]),
        np.float32(EPSILON),
    )


@kernel(fastmath=True, error_model="numpy")
def step_touched(
    part: int,
    count: int,
    step: int,
    touched: tuple[Touched, ...],
    sums: tuple[Floats, ...],
    moments: Moments,
    rates: Rates,
) -> None:
    """Adam on the ``count`` rows that the thread ``part`` touched; clears their sums.

    A row that several threads touched is left to the first of them.
    """
    rows = touched[part].rows
    for i in range(count):
        ahead = rows[min(i + _AHEAD, count - 1)]
        prefetch_row(sums[part], ahead)
        prefetch_row(moments.values, ahead)
        prefetch_row(moments.means, ahead)
        prefetch_row(moments.variances, ahead)
        row = rows[i]
        mine = True
        for other in range(len(touched)):
            if other == part or touched[other].stamps[row] != step:
                continue
            if other < part:
                mine = False
                break
            for k in range(sums[part].shape[1]):
                sums[part][row, k] += sums[other][row, k]
                sums[other][row, k] = 0
        if mine:
            step_row(row, sums[part], moments, rates)
