"""Training a field in compiled code, on the CPU, by Adam (Kingma and Ba 2015, algorithm 1).

A step touches some rows of a parameter. With its gradient ``g``, a row that takes its ``t``-th step
changes by::

    mean     += (1 - mean_decay) * (g - mean)
    variance += (1 - variance_decay) * (g**2 - variance)
    m, v      = mean / (1 - mean_decay**t), variance / (1 - variance_decay**t)
    value    -= learning_rate * m / (sqrt(v) + EPSILON)

Steps are counted row by row, so that the moments of a row that is new or seldom touched are
corrected for its own age.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from triquad_format.records.arrays import Floats, Ints
from triquad_map.compiled.field.feature_rows import move_row, prefetch_row
from triquad_map.compiled.field.field import Touched, accumulate, make_field
from triquad_map.compiled.field.mlp import Mlp
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.team import THREADS, Team, share

from triquad_server.engine.live_field import LiveField, Parameter

EPSILON = 1e-10

_NEGLIGIBLE = 1e-8
_MAX_CORRECTED = 1 << 20
_AHEAD = 12  # rows that are brought into the cache before their turn
_LAST_STEP = 2**31 - 1


@dataclass(frozen=True)
class Batch:
    """Samples that one step of training learns from."""

    points: Tensor  # [B, 3] metres from the region's centre
    labels: Tensor  # [B] signed distances, metres


@dataclass(frozen=True)
class Rates:
    """How fast values and moments follow the gradients."""

    learning_rate: float
    mean_decay: float  # in [0, 1), as is the next
    variance_decay: float


class ParameterRows(NamedTuple):
    """The memory of a parameter, as kernels take it."""

    values: Floats  # [rows, size]
    means: Floats  # [rows, size]
    variances: Floats  # [rows, size]
    steps: Ints  # [rows]


class CompiledRates(NamedTuple):
    """Rates with their corrections by age, as kernels take them."""

    learning_rate: float
    mean_decay: float
    variance_decay: float
    mean_scales: Floats  # [n] correction of the mean after 1, 2, ... steps; the last for more
    variance_scales: Floats  # [n] and of the variance


def _parameter_rows(parameter: Parameter) -> ParameterRows:
    """A parameter's own memory, each row flattened."""
    count = len(parameter)
    return ParameterRows(
        values=parameter.values.numpy().reshape(count, -1),
        means=parameter.means.numpy().reshape(count, -1),
        variances=parameter.variances.numpy().reshape(count, -1),
        steps=parameter.steps.numpy(),
    )


def _compiled_rates(rates: Rates) -> CompiledRates:
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
def _step_row(row: int, gradients: Floats, parameter: ParameterRows, rates: CompiledRates) -> None:
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
def _step_touched(
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
            _step_row(row, sums[part], parameter, rates)


class GradientSums:
    """Room for the gradients of the feature rows, for each thread; all but row 0 are zero between
    steps.

    Trainers that do not train at the same time share it.
    """

    def __init__(self) -> None:
        self.features: tuple[Floats, ...] = ()  # per thread [rows, size]
        self.touched: tuple[Touched, ...] = ()  # per thread
        self.step = 0

    def begin(self, rows: int, size: int) -> None:
        """Make room for a step with ``rows`` of ``size`` numbers."""
        self.step += 1
        known = self.features[0].shape if self.features else (0, 0)
        if known[0] < rows or known[1] != size or self.step == _LAST_STEP:
            room = rows + rows // 4
            self.step = 1
            self.features = tuple(np.zeros((room, size), np.float32) for _ in range(THREADS))
            self.touched = tuple(
                Touched(np.zeros(room, np.int32), np.zeros(room, np.int32)) for _ in range(THREADS)
            )


class CompiledTrainer:
    """Trains a field in compiled code, in its own memory, which is the CPU's."""

    def __init__(self, field: LiveField, sums: GradientSums, team: Team) -> None:
        self._field = field
        self._sums = sums
        self._team = team

    def train(self, batch: Batch, rates: Rates) -> float:
        """One optimiser step; returns the loss before it."""
        points = batch.points.numpy()
        targets = torch.sigmoid(batch.labels / self._field.settings.logit_scale_m).numpy()
        field = make_field(self._field.settings, self._field.tree, self._field.arrays)
        sums = self._sums
        sums.begin(*field.features.shape)
        mlp_sums = [Mlp(*map(np.zeros_like, field.mlp)) for _ in range(THREADS)]
        counts = [0] * THREADS
        losses = [0.0] * THREADS

        def work(part: int) -> None:
            mine = slice(*share(len(points), part))
            counts[part], losses[part] = accumulate(
                points[mine],
                targets[mine],
                1.0 / len(points),
                field,
                mlp_sums[part],
                sums.features[part],
                sums.touched[part],
                sums.step,
            )

        self._team.each(work)
        self._step(counts, mlp_sums, _compiled_rates(rates))
        return sum(losses)

    def _step(self, counts: list[int], mlp_sums: list[Mlp], rates: CompiledRates) -> None:
        """Adam on the MLP and on the rows that were touched, so many by each thread."""
        for part, parameter in enumerate(self._field.mlp):
            gradient = np.sum([thread[part] for thread in mlp_sums], axis=0).reshape(1, -1)
            _step_row(0, gradient, _parameter_rows(parameter), rates)
        sums, features = self._sums, _parameter_rows(self._field.features)
        self._team.each(
            lambda part: _step_touched(
                part, counts[part], sums.step, sums.touched, sums.features, features, rates
            )
        )
