"""Adam (Kingma and Ba 2015, algorithm 1) for parameters of which a step touches some rows.

With its gradient ``g``, a row that takes its ``t``-th step changes by::

    mean     += (1 - mean_decay) * (g - mean)
    variance += (1 - variance_decay) * (g**2 - variance)
    m, v      = mean / (1 - mean_decay**t), variance / (1 - variance_decay**t)
    value    -= learning_rate * m / (sqrt(v) + EPSILON)

Steps are counted row by row, so that the moments of a row that is new or seldom touched are
corrected for its own age. The rule is here in tensors, for any device, and compiled, for the CPU.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from triquad_format.records.arrays import Floats, Ints
from triquad_map.compiled.field.feature_rows import move_row, prefetch_row
from triquad_map.compiled.kernel import kernel

EPSILON = 1e-10

_NEGLIGIBLE = 1e-8
_MAX_CORRECTED = 1 << 20
_AHEAD = 12  # rows that are brought into the cache before their turn


@dataclass(frozen=True)
class Rates:
    """How fast values and moments follow the gradients."""

    learning_rate: float
    mean_decay: float  # in [0, 1), as is the next
    variance_decay: float


class Parameter:
    """Rows of trained values with the optimiser's state of each; growing keeps both together.

    All four tensors are views of the rows in use, which the optimiser changes in place.
    """

    def __init__(self, values: Tensor) -> None:
        """Begin with ``values`` [rows, ...], which are copied, and no steps taken."""
        self._count = len(values)
        self._values = values.clone()
        self._means = torch.zeros_like(values)
        self._variances = torch.zeros_like(values)
        self._steps = torch.zeros(len(values), dtype=torch.int32, device=values.device)

    def __len__(self) -> int:
        return self._count

    @property
    def values(self) -> Tensor:
        """The parameter [rows, ...]."""
        return self._values[: self._count]

    @property
    def means(self) -> Tensor:
        """Running means of the gradients, shaped as ``values``."""
        return self._means[: self._count]

    @property
    def variances(self) -> Tensor:
        """Running means of the squared gradients, shaped as ``values``."""
        return self._variances[: self._count]

    @property
    def steps(self) -> Tensor:
        """Steps that each row took [rows] int32."""
        return self._steps[: self._count]

    def append(self, values: Tensor) -> None:
        """Add rows that took no step yet; the state of the others stays."""
        count = self._count + len(values)
        if count > len(self._values):
            capacity = max(count, 2 * len(self._values))
            self._values = _with_room(self._values, capacity)
            self._means = _with_room(self._means, capacity)
            self._variances = _with_room(self._variances, capacity)
            self._steps = _with_room(self._steps, capacity)
        new = slice(self._count, count)
        self._values[new] = values
        for state in (self._means, self._variances, self._steps):
            state[new] = 0
        self._count = count

    def restore(self, means: Tensor, variances: Tensor, steps: Tensor) -> None:
        """Take over optimiser state, shaped as this parameter's."""
        self.means.copy_(means)
        self.variances.copy_(variances)
        self.steps.copy_(steps)


def _with_room(rows: Tensor, capacity: int) -> Tensor:
    # Memory that nothing has been written to is not taken from the system.
    roomy = rows.new_empty((capacity, *rows.shape[1:]))
    roomy[: len(rows)] = rows
    return roomy


def step_rows(parameter: Parameter, rows: Tensor, gradient: Tensor, rates: Rates) -> None:
    """One step of ``rows`` [T], all different, along their ``gradient`` [T, ...]."""
    parameter.steps[rows] += 1
    means = parameter.means[rows].lerp_(gradient, 1 - rates.mean_decay)
    variances = parameter.variances[rows].lerp_(gradient.square(), 1 - rates.variance_decay)
    parameter.means[rows] = means
    parameter.variances[rows] = variances
    direction = _direction(means, variances, parameter.steps[rows], rates)
    parameter.values[rows] -= rates.learning_rate * direction


def step_where(parameter: Parameter, mask: Tensor, gradient: Tensor, rates: Rates) -> None:
    """As :func:`step_rows` for the rows where ``mask`` [rows] is set; ``gradient`` [rows, ...].

    It goes over all rows, but need not know how many are set, for which a GPU would have to be
    waited for.
    """
    parameter.steps.add_(mask)
    mask = mask.reshape(-1, *[1] * (gradient.dim() - 1))
    parameter.means.lerp_(gradient, (1 - rates.mean_decay) * mask)
    parameter.variances.lerp_(gradient.square(), (1 - rates.variance_decay) * mask)
    steps = parameter.steps.clamp(min=1)
    direction = _direction(parameter.means, parameter.variances, steps, rates)
    parameter.values.sub_(rates.learning_rate * mask * direction)


def _direction(means: Tensor, variances: Tensor, steps: Tensor, rates: Rates) -> Tensor:
    """What rows [R, ...] that took ``steps`` [R] lose at a learning rate of 1."""
    age = steps.to(means.dtype).reshape(-1, *[1] * (means.dim() - 1))
    mean = means / (1 - rates.mean_decay**age)
    deviation = (variances / (1 - rates.variance_decay**age)).sqrt_()
    return mean / (deviation + EPSILON)


class ParameterRows(NamedTuple):
    """The memory of a parameter, as kernels take it."""

    values: Floats  # [rows, size]
    means: Floats  # [rows, size]
    variances: Floats  # [rows, size]
    steps: Ints  # [rows]


class Touched(NamedTuple):
    """Which feature rows a thread has added a gradient to."""

    stamps: Ints  # [rows] the step in which each row was touched last
    rows: Ints  # [rows] those touched in this step, in the order in which they were


class CompiledRates(NamedTuple):
    """Rates with their corrections by age, as kernels take them."""

    learning_rate: float
    mean_decay: float
    variance_decay: float
    mean_scales: NDArray[
        np.float32
    ]  # [n] correction of the mean after 1, 2, ... steps; the last for more
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
