"""Trains a field in compiled code, on the CPU, by Adam (Kingma and Ba 2015, algorithm 1).

A step touches some rows of a parameter. With its gradient ``g``, a row that takes its ``t``-th step
changes by::

    mean     += (1 - mean_decay) * (g - mean)
    variance += (1 - variance_decay) * (g**2 - variance)
    m, v      = mean / (1 - mean_decay**t), variance / (1 - variance_decay**t)
    value    -= learning_rate(t) * m / (sqrt(v) + EPSILON)

Steps are counted row by row, so that the moments of a row that is new or seldom touched are
corrected for its own age. A row's learning rate falls with its age, too: what is learnt hardens.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from triquad_format.records.arrays import Floats, Ints
from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.lanes import prefetch_row
from triquad_map.compiled.team import THREADS, Team, share
from triquad_map.field.encoding import BATCH, PointBatch, add_feature_gradient, load
from triquad_map.field.feature_rows import move_row
from triquad_map.field.field import (
    CompiledField,
    Mlp,
    add_weight_gradient,
    backward,
    batch_for,
    forward,
    make_field,
    transposed,
)

from triquad_server.engine.gradient_sums import GradientSums, Touched
from triquad_server.engine.live_field import (
    AGES,
    Batch,
    LiveField,
    Parameter,
    rate_share,
)
from triquad_server.engine.memory import Memory

if TYPE_CHECKING:
    from triquad_server.engine.tensor_trainer import TensorTrainer

Loss = Any
"""A number that a GPU may still be computing; reading it as a float waits for that."""

MEAN_DECAY, VARIANCE_DECAY, EPSILON = 0.9, 0.99, 1e-10  # beta1, beta2 and epsilon of Adam

_AHEAD = 12  # rows that are fetched into the cache in advance


class ParameterRows(NamedTuple):
    """The memory of a parameter, as kernels take it."""

    values: Floats  # [rows, size]
    means: Floats  # [rows, size]
    variances: Floats  # [rows, size]
    steps: Ints  # [rows]


class Rates(NamedTuple):
    """The learning rate, and what it and the variance are to be multiplied by at each age."""

    learning_rate: float
    mean_scales: Floats = (rate_share(AGES) / (1 - MEAN_DECAY**AGES)).astype(np.float32)
    """[n] The share of the rate after 1, 2, ... steps, with the correction of the mean; the last
    one applies to more steps."""

    variance_scales: Floats = (1 / (1 - VARIANCE_DECAY**AGES)).astype(np.float32)  # [n]


def _parameter_rows(parameter: Parameter) -> ParameterRows:
    """Return a parameter's own memory, each row flattened."""
    count = len(parameter)
    return ParameterRows(
        values=parameter.values.reshape(count, -1),
        means=parameter.means.reshape(count, -1),
        variances=parameter.variances.reshape(count, -1),
        steps=parameter.steps,
    )


@kernel(fastmath=True, inline="always")
def _step_row(row: int, gradients: Floats, parameter: ParameterRows, rates: Rates) -> None:
    """Take one step of a row along its gradient, and clear the gradient."""
    parameter.steps[row] += 1
    age = min(parameter.steps[row], len(rates.mean_scales)) - 1
    move_row(
        gradients,
        parameter.values,
        parameter.means,
        parameter.variances,
        row,
        (np.float32(1 - MEAN_DECAY), np.float32(1 - VARIANCE_DECAY)),
        (np.float32(rates.learning_rate) * rates.mean_scales[age], rates.variance_scales[age]),
        np.float32(EPSILON),
    )


@kernel(fastmath=True)
def _step_touched(
    part: int,
    count: int,
    step: int,
    touched: tuple[Touched, ...],
    sums: tuple[Floats, ...],
    parameter: ParameterRows,
    rates: Rates,
) -> None:
    """Apply Adam to the ``count`` rows that the thread ``part`` touched, and clear their sums.

    A row that several threads touched is updated by the first of them.
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


@inner_kernel(fastmath=True)
def _record_touched(batch: PointBatch, count: int, touched: Touched, step: int, known: int) -> int:
    """Add the rows of the first ``count`` points to the ``known`` ones; return the new number."""
    for t in range(count):
        for i in range(batch.rows.shape[1]):
            row = batch.rows[t, i]
            if touched.stamps[row] != step and row != 0:  # absent vertices are not trained
                touched.stamps[row] = step
                touched.rows[known] = row
                known += 1
    return known


@inner_kernel(fastmath=True)
def _squashed(logit: float, tail: float) -> float:
    """Return a logit as a number in [0, 1]; its ``tail`` is ``exp(-abs(logit))``, never large."""
    squashed: float = (np.float32(1) if logit >= 0 else tail) / (np.float32(1) + tail)
    return squashed


@inner_kernel(fastmath=True)
def _cross_entropy(batch: PointBatch, wanted: Floats, share: float) -> float:
    """Set the slopes of the batch's logits, and return the sum of the losses."""
    loss = 0.0
    batch.slopes[:] = 0
    for t in range(len(wanted)):
        logit = batch.logits[t]
        tail = np.exp(-abs(logit))
        target = _squashed(wanted[t], np.exp(-abs(wanted[t])))
        loss += max(logit, np.float32(0)) - logit * target + np.log1p(tail)
        batch.slopes[t] = (_squashed(logit, tail) - target) * np.float32(share)
    return loss


@kernel(fastmath=True)
def _add_loss_gradient(
    points: Floats,
    wanted: Floats,
    share: float,
    field: CompiledField,
    mlp_sums: Mlp,
    feature_sums: Floats,
    touched: Touched,
    step: int,
) -> tuple[int, float]:
    """Add the gradient of the cross entropy between ``wanted`` [N] and the logits, both squashed.

    Args:
        points: [N, 3] metres from the region's centre.
        wanted: [N] the logits that there should be.
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
    batch = batch_for(field)
    w1_transposed, w2_transposed = transposed(field.mlp, levels * field.features.shape[1])
    known = np.int64(0)
    loss = 0.0
    for first in range(0, len(points), BATCH):
        count = load(batch, points, first)
        forward(batch, field)
        loss += _cross_entropy(batch, wanted[first : first + count], share)
        backward(batch, field.mlp, w1_transposed, w2_transposed)
        add_weight_gradient(batch, mlp_sums)
        if levels > 0:
            add_feature_gradient(batch, count, levels, feature_sums)
            known = _record_touched(batch, count, touched, step, known)
    return known, float(loss * share)


class CompiledTrainer:
    """Trains a field in compiled code, in the arrays that hold it."""

    def __init__(self, field: LiveField, sums: GradientSums, team: Team) -> None:
        self._field = field
        self._sums = sums
        self._team = team

    def train(self, batch: Batch, rate: float) -> float:
        """Take one optimiser step; return the loss before it."""
        points = batch.points
        wanted = batch.labels / np.float32(self._field.settings.logit_scale_m)
        self._field.thaw()
        field = make_field(self._field.settings, self._field.tree, self._field.arrays)
        sums = self._sums
        sums.begin(*field.features.shape)
        mlp_sums = [Mlp(*map(np.zeros_like, field.mlp)) for _ in range(THREADS)]
        counts = [0] * THREADS
        losses = [0.0] * THREADS

        def work(part: int) -> None:
            mine = slice(*share(len(points), part))
            counts[part], losses[part] = _add_loss_gradient(
                points[mine],
                wanted[mine],
                1.0 / len(points),
                field,
                mlp_sums=mlp_sums[part],
                feature_sums=sums.features[part],
                touched=sums.touched[part],
                step=sums.step,
            )

        self._team.each(work)
        self._step_mlp(mlp_sums, rate)
        self._step_features(counts, rate)
        return sum(losses)

    def _step_features(self, counts: list[int], rate: float) -> None:
        """Apply Adam to the touched rows, ``counts`` of them by each thread."""
        sums, features = self._sums, _parameter_rows(self._field.features)

        def work(part: int) -> None:
            _step_touched(
                part,
                counts[part],
                sums.step,
                sums.touched,
                sums.features,
                parameter=features,
                rates=Rates(rate),
            )

        self._team.each(work)

    def _step_mlp(self, sums: list[Mlp], rate: float) -> None:
        """Apply Adam to the MLP, by the gradients of each thread."""
        rates = Rates(self._field.next_mlp_share() * rate)
        for part, parameter in enumerate(self._field.mlp):
            gradient = np.sum([thread[part] for thread in sums], axis=0).reshape(1, -1)
            _step_row(0, gradient, _parameter_rows(parameter), rates)


def trainer_of(
    field: LiveField, sums: GradientSums, team: Team
) -> "CompiledTrainer | TensorTrainer":
    """Return the trainer of a field; ``sums`` and ``team`` are for compiled code."""
    if type(field.memory) is Memory:
        return CompiledTrainer(field, sums, team)
    from triquad_server.engine.tensor_trainer import TensorTrainer

    return TensorTrainer(field)
