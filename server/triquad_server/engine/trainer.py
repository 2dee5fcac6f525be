"""Training a field: in compiled code on the CPU; on tensors, the reference, elsewhere."""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from triquad_format.records.arrays import Floats
from triquad_map.compiled.field.field import Touched, accumulate, make_field
from triquad_map.compiled.field.mlp import Mlp
from triquad_map.compiled.team import THREADS, Team, share

from triquad_server.engine.adam import (
    CompiledRates,
    Rates,
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
        """One optimiser step; returns the loss before it.

        The loss is the cross entropy between the two distances squashed by a sigmoid
        (3QFP, equation 5).
        """
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
