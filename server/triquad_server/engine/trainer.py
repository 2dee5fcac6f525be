"""Training a field: in compiled code on the CPU; on tensors, the reference, elsewhere.

The loss is the cross entropy between the true and the field's distances, both squashed by a sigmoid
(3QFP, equation 5).
"""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from triquad_format.records.arrays import Floats
from triquad_map.compiled.field.encoding import BATCH, PointBatch, add_feature_gradient, load
from triquad_map.compiled.field.field import (
    CompiledField,
    Mlp,
    add_weight_gradient,
    backward,
    batch_for,
    forward,
    make_field,
    transposed,
)
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.team import THREADS, Team, share

from triquad_server.engine.adam import (
    CompiledRates,
    Rates,
    Touched,
    compiled_rates,
    parameter_rows,
    step_row,
    step_rows,
    step_touched,
    step_where,
)
from triquad_server.engine.live_field import LiveField
from triquad_server.engine.tensor_field import Corners, TensorField

_LAST_STEP = 2**31 - 1


@dataclass(frozen=True)
class Batch:
    """Samples that one step of training learns from."""

    points: Tensor  # [B, 3] metres from the region's centre
    labels: Tensor  # [B] signed distances, metres


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


@kernel(fastmath=True)
def _record_touched(batch: PointBatch, count: int, touched: Touched, step: int, known: int) -> int:
    """Add the rows of the first ``count`` points to the ``known`` ones; returns how many now."""
    for t in range(count):
        for i in range(batch.rows.shape[1]):
            row = batch.rows[t, i]
            if touched.stamps[row] != step and row != 0:  # absent vertices learn nothing
                touched.stamps[row] = step
                touched.rows[known] = row
                known += 1
    return known


@kernel(fastmath=True)
def _cross_entropy(batch: PointBatch, targets: Floats, share: float) -> float:
    """Set the slopes of the batch's logits; returns the sum of the losses."""
    loss = 0.0
    batch.slopes[:] = 0
    for t in range(len(targets)):
        logit = batch.logits[t]
        tail = np.exp(-abs(logit))  # never overflows
        squashed = (np.float32(1) if logit >= 0 else tail) / (np.float32(1) + tail)
        loss += max(logit, np.float32(0)) - logit * targets[t] + np.log1p(tail)
        batch.slopes[t] = (squashed - targets[t]) * np.float32(share)
    return loss


@kernel(fastmath=True)
def _add_loss_gradient(
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
    batch = batch_for(field)
    w1_transposed, w2_transposed = transposed(field.mlp, levels * field.features.shape[1])
    known = 0
    loss = 0.0
    for first in range(0, len(points), BATCH):
        count = load(batch, points, first)
        forward(batch, field)
        loss += _cross_entropy(batch, targets[first : first + count], share)
        backward(batch, field.mlp, w1_transposed, w2_transposed)
        add_weight_gradient(batch, mlp_sums)
        if levels > 0:
            add_feature_gradient(batch, count, levels, feature_sums)
            known = _record_touched(batch, count, touched, step, known)
    return known, float(loss * share)


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
        field = make_field(self._field.settings, self._field.tree, self._field.tensors.arrays)
        sums = self._sums
        sums.begin(*field.features.shape)
        mlp_sums = [Mlp(*map(np.zeros_like, field.mlp)) for _ in range(THREADS)]
        counts = [0] * THREADS
        losses = [0.0] * THREADS

        def work(part: int) -> None:
            mine = slice(*share(len(points), part))
            counts[part], losses[part] = _add_loss_gradient(
                points[mine],
                targets[mine],
                1.0 / len(points),
                field,
                mlp_sums=mlp_sums[part],
                feature_sums=sums.features[part],
                touched=sums.touched[part],
                step=sums.step,
            )

        self._team.each(work)
        self._step(counts, mlp_sums, compiled_rates(rates))
        return sum(losses)

    def _step(self, counts: list[int], mlp_sums: list[Mlp], rates: CompiledRates) -> None:
        """Adam on the MLP and on the rows that were touched, so many by each thread."""
        for part, parameter in enumerate(self._field.mlp):
            gradient = np.sum([thread[part] for thread in mlp_sums], axis=0).reshape(1, -1)
            step_row(0, gradient, parameter_rows(parameter), rates)
        sums, features = self._sums, parameter_rows(self._field.features)
        self._team.each(
            lambda part: step_touched(
                part, counts[part], sums.step, sums.touched, sums.features, features, rates
            )
        )


class TensorTrainer:
    """Trains a field by automatic differentiation, on the device where it is."""

    def __init__(self, field: LiveField) -> None:
        self._field = field
        self._tensor_field = TensorField(field.settings, field.tree, field.tensors)

    def train(self, batch: Batch, rates: Rates) -> Tensor:
        """One optimiser step; returns the loss before it."""
        field = self._up_to_date()
        corners = field.around(batch.points)
        encoded = None if corners is None else field.gather(corners).requires_grad_()
        mlp = tuple(part.detach().requires_grad_() for part in field.tensors.mlp)
        with torch.enable_grad():
            logits = field.logits(batch.points, encoded, mlp)
            target = torch.sigmoid(batch.labels / field.settings.logit_scale_m)
            loss = F.binary_cross_entropy_with_logits(logits, target)
            torch.autograd.backward(loss)
        first_row = torch.zeros(1, dtype=torch.int64, device=field.device)
        for parameter, weight in zip(self._field.mlp, mlp, strict=True):
            assert weight.grad is not None
            step_rows(parameter, first_row, weight.grad[None], rates)
        if corners is not None and encoded is not None and encoded.grad is not None:
            self._step_features(corners, encoded.grad, rates)
        return loss.detach()

    def _up_to_date(self) -> TensorField:
        """The field with all vertices that it has now."""
        if len(self._tensor_field.tensors.features) != len(self._field.features):
            field = self._field
            self._tensor_field = TensorField(field.settings, field.tree, field.tensors)
        return self._tensor_field

    def _step_features(self, corners: Corners, gradient: Tensor, rates: Rates) -> None:
        features = self._field.features
        size = features.values.shape[1]
        rows = corners.rows.view(-1)
        shares = gradient.view(-1, 1, size) * corners.weights.view(-1, corners.rows.shape[2], 1)
        total = torch.zeros_like(features.values)
        total.index_add_(0, rows, shares.view(-1, size))
        touched = torch.zeros(len(total), dtype=torch.bool, device=total.device)
        touched[rows] = True
        touched[0] = False  # absent vertices stay zero
        if total.device.type == "cpu":
            chosen = touched.nonzero()[:, 0]
            step_rows(features, chosen, total[chosen], rates)
        else:
            step_where(features, touched, total, rates)
