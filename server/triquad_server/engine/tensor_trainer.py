"""Trains a field on tensors, by automatic differentiation: any device, and the reference."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from triquad_server.engine.compiled_trainer import EPSILON, MEAN_DECAY, VARIANCE_DECAY
from triquad_server.engine.live_field import (
    LAST_AGE,
    Batch,
    LiveField,
    Parameter,
    rate_share,
)
from triquad_server.engine.tensor_field import Corners, TensorField, tensors_of


class ParameterTensors(NamedTuple):
    """The memory of a parameter."""

    values: Tensor  # [rows, ...]
    means: Tensor  # [rows, ...]
    variances: Tensor  # [rows, ...]
    steps: Tensor  # [rows]

    @classmethod
    def of(cls, parameter: Parameter) -> "ParameterTensors":
        """Return a parameter's own memory, be it tensors or arrays."""
        parts = (parameter.values, parameter.means, parameter.variances, parameter.steps)
        return cls(*map(torch.as_tensor, parts))


class TensorTrainer:
    """Trains a field by automatic differentiation, in its own memory: on a device, or in arrays."""

    def __init__(self, field: LiveField) -> None:
        self._field = field
        self._tensor_field = TensorField(field.settings, field.tree, tensors_of(field))

    def train(self, batch: Batch, rate: float) -> Tensor:
        """Take one optimiser step; return the loss before it.

        The loss is the cross entropy between the two distances squashed by a sigmoid
        (3QFP, equation 5).
        """
        field = self._up_to_date()
        points, labels = (
            torch.as_tensor(part, device=field.device) for part in (batch.points, batch.labels)
        )
        corners = field.around(points)
        encoded = None if corners is None else field.gather(corners).requires_grad_()
        mlp = tuple(part.detach().requires_grad_() for part in field.tensors.mlp)
        with torch.enable_grad():
            logits = field.logits(points, encoded, mlp)
            target = torch.sigmoid(labels / field.settings.logit_scale_m)
            loss = F.binary_cross_entropy_with_logits(logits, target)
            torch.autograd.backward(loss)
        self._step_mlp(mlp, rate)
        if corners is not None and encoded is not None and encoded.grad is not None:
            self._step_features(corners, encoded.grad, rate)
        return loss.detach()

    def _up_to_date(self) -> TensorField:
        """Return the field with all its present vertices, in their present memory."""
        field = self._field
        field.thaw()
        tensors = tensors_of(field)
        if len(self._tensor_field.tensors.features) != len(tensors.features):
            self._tensor_field = TensorField(field.settings, field.tree, tensors)
        else:
            self._tensor_field.tensors = tensors
        return self._tensor_field

    def _step_mlp(self, mlp: tuple[Tensor, ...], rate: float) -> None:
        first_row = torch.zeros(1, dtype=torch.int64, device=self._tensor_field.device)
        share = self._field.next_mlp_share()
        for parameter, weight in zip(self._field.mlp, mlp, strict=True):
            assert weight.grad is not None
            tensors = ParameterTensors.of(parameter)
            step_rows(tensors, first_row, weight.grad[None], share * rate)

    def _step_features(self, corners: Corners, gradient: Tensor, rate: float) -> None:
        features = ParameterTensors.of(self._field.features)
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
            step_rows(features, chosen, total[chosen], rate)
        else:
            step_where(features, touched, total, rate)


def step_rows(parameter: ParameterTensors, rows: Tensor, gradient: Tensor, rate: float) -> None:
    """Take one step of ``rows`` [T], all different, along their ``gradient`` [T, ...]."""
    parameter.steps[rows] += 1
    means = parameter.means[rows].lerp_(gradient, 1 - MEAN_DECAY)
    variances = parameter.variances[rows].lerp_(gradient.square(), 1 - VARIANCE_DECAY)
    parameter.means[rows] = means
    parameter.variances[rows] = variances
    parameter.values[rows] -= _change(means, variances, parameter.steps[rows], rate)


def step_where(parameter: ParameterTensors, mask: Tensor, gradient: Tensor, rate: float) -> None:
    """Do as :func:`step_rows` for the rows where ``mask`` [rows] is set; ``gradient`` [rows, ...].

    It processes all rows, but need not know how many are set, which would mean waiting for a GPU.
    """
    parameter.steps.add_(mask)
    mask = mask.reshape(-1, *[1] * (gradient.dim() - 1))
    parameter.means.lerp_(gradient, (1 - MEAN_DECAY) * mask)
    parameter.variances.lerp_(gradient.square(), (1 - VARIANCE_DECAY) * mask)
    steps = parameter.steps.clamp(min=1)
    change = _change(parameter.means, parameter.variances, steps, rate)
    parameter.values.sub_(mask * change)


def _change(means: Tensor, variances: Tensor, steps: Tensor, rate: float) -> Tensor:
    """Return the decrease of rows [R, ...] that took ``steps`` [R], this one included."""
    age = steps.to(means.dtype).reshape(-1, *[1] * (means.dim() - 1))
    mean = means / (1 - MEAN_DECAY**age)
    deviation = (variances / (1 - VARIANCE_DECAY**age)).sqrt_()
    change: Tensor = rate * rate_share(age.clamp(max=LAST_AGE)) * mean / (deviation + EPSILON)
    return change
