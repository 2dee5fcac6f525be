"""Adam in compiled code: the rule of :mod:`triquad_server.engine.adam`, on the touched rows."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_map.compiled.field.feature_rows import move_row, prefetch_row
from triquad_map.compiled.field.field import Touched
from triquad_map.compiled.kernel import kernel

from triquad_server.engine.adam import EPSILON, Rates
from triquad_server.engine.parameter import Parameter

Floats = NDArray[np.float32]

_NEGLIGIBLE = 1e-8
_MAX_CORRECTED = 1 << 20
_AHEAD = 12  # rows that are brought into the cache before their turn


class ParameterRows(NamedTuple):
    """The memory of a parameter, as kernels take it."""

    values: Floats  # [rows, size]
    means: Floats  # [rows, size]
    variances: Floats  # [rows, size]
    steps: NDArray[np.int32]  # [rows]


class CompiledRates(NamedTuple):
    """Rates with their corrections by age, as kernels take them."""

    learning_rate: float
    mean_decay: float
    variance_decay: float
    mean_scales: Floats  # [n] correction of the mean after 1, 2, ... steps; the last for more
    variance_scales: Floats  # [n] and of the variance


def parameter_rows(parameter: Parameter) -> ParameterRows:
    """A parameter's own memory, each row flattened."""
    count = len(parameter)
    return ParameterRows(
        parameter.values.numpy().reshape(count, -1),
        parameter.means.numpy().reshape(count, -1),
        parameter.variances.numpy().reshape(count, -1),
        parameter.steps.numpy(),
    )


def compiled_rates(rates: Rates) -> CompiledRates:
    """The numbers of a step."""
    mean_decay, variance_decay = rates.mean_decay, rates.variance_decay
    scales = _corrections(mean_decay, variance_decay)
    return CompiledRates(rates.learning_rate, mean_decay, variance_decay, *scales)


@lru_cache(maxsize=4)
def _corrections(mean_decay: float, variance_decay: float) -> tuple[Floats, Floats]:
    """Scales of mean and variance by age, tabulated until they no longer matter."""
    slowest = max(mean_decay, variance_decay)
    count = min(_MAX_CORRECTED, 1 + int(np.log(_NEGLIGIBLE) / np.log(slowest)))
    ages = np.arange(1, count + 1)
    return (
        (1 / (1 - mean_decay**ages)).astype(np.float32),
        (1 / (1 - variance_decay**ages)).astype(np.float32),
    )


@kernel(fastmath=True, error_model="numpy", inline="always")
def step_row(row: int, gradients: Floats, parameter: ParameterRows, rates: CompiledRates) -> None:
    """One step of a row along its gradient, which is cleared."""
    parameter.steps[row] += 1
    age = min(parameter.steps[row], len(rates.mean_scales)) - 1
    move_row(
        gradients,
        parameter.values,
        parameter.means,
        parameter.variances,
        row,
        (np.float32(1 - rates.mean_decay), np.float32(1 - rates.variance_decay)),
        (np.float32(rates.learning_rate) * rates.mean_scales[age], rates.variance_scales[age]),
        np.float32(EPSILON),
    )


@kernel(fastmath=True, error_model="numpy")
def step_touched(
    part: int,
    count: int,
    step: int,
    touched: tuple[Touched, ...],
    sums: tuple[Floats, ...],
    parameter: ParameterRows,
    rates: CompiledRates,
) -> None:
    """Adam on the ``count`` rows that the thread ``part`` touched; clears their sums.

    A row that several threads touched is left to the first of them.
    """
    rows = touched[part].rows
    for i in range(count):
        ahead = rows[min(i + _AHEAD, count - 1)]
        prefetch_row(sums[part], ahead)
        prefetch_row(parameter.values, ahead)
        prefetch_row(parameter.means, ahead)
        prefetch_row(parameter.variances, ahead)
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
            step_row(row, sums[part], parameter, rates)
