"""Two engines for one field: tensors on any device, compiled code on the CPU."""

from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from triquad_map.compiled.field import field as compiled_field
from triquad_map.compiled.field.field import CompiledField, Touched
from triquad_map.compiled.field.frozen_field import field_values, make_field
from triquad_map.compiled.field.mlp import Mlp
from triquad_map.compiled.team import THREADS, share
from triquad_map.composition.region import FieldEngine, FieldValues

from triquad_server.engine.adam import Betas, Parameter
from triquad_server.engine.compiled_adam import Moments, Rates, rates, step_row, step_touched
from triquad_server.engine.field import Field
from triquad_server.mapping.sampling import Batch
from triquad_server.threads import MAPPING

_LAST_STEP = 2**31 - 1
_CHUNK = 131_072  # points that tensors are made for at a time


Loss = float | torch.Tensor
"""A number, or a tensor that holds it on a device: to look at it there, one has to wait."""


class Engine(FieldEngine, Protocol):
    """What computes a field and trains it."""

    def train(self, batch: Batch, rate: float, betas: Betas) -> Loss:
        """One optimiser step; returns the loss before it."""


class GradientSums:
    """Room for the gradients of the feature rows, for each thread; all but row 0 are zero between
    steps.

    Engines that are not trained at the same time share it.
    """

    def __init__(self) -> None:
        self.features: tuple[NDArray[np.float32], ...] = ()  # per thread [rows, size]
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


def make_engine(field: Field, sums: GradientSums | None = None) -> Engine:
    """The engine for a field: compiled code on the CPU, tensors elsewhere.

    Without ``sums`` it is for a field that never changes.
    """
    return CompiledEngine(field, sums) if field.device.type == "cpu" else TorchEngine(field)


class TorchEngine:
    """Tensors and automatic differentiation: the reference, on any device."""

    def __init__(self, field: Field) -> None:
        self._field = field

    def evaluate(self, points: NDArray[np.float32], gradient: bool) -> FieldValues:
        """The field at points [N, 3], metres from the region's centre."""
        parts = [
            self._evaluate(points[start : start + _CHUNK], gradient)
            for start in range(0, max(1, len(points)), _CHUNK)
        ]
        return FieldValues(
            np.concatenate([part.sdf for part in parts]),
            np.concatenate([part.gradient for part in parts]),
        )

    def _evaluate(self, points: NDArray[np.float32], gradient: bool) -> FieldValues:
        tensor = torch.from_numpy(points).to(self._field.device)
        if gradient:
            value, slope = self._field.sdf_and_gradient(tensor)
            return FieldValues(value.cpu().numpy(), slope.cpu().numpy())
        with torch.no_grad():
            value = self._field.sdf(tensor)
        return FieldValues(value.cpu().numpy(), np.zeros((0, 3), np.float32))

    def train(self, batch: Batch, rate: float, betas: Betas) -> Loss:
        """One optimiser step; returns the loss before it."""
        return self._field.train(batch.points, batch.labels, rate, betas)


class CompiledEngine:
    """Compiled kernels over the field's own memory, on all cores."""

    def __init__(self, field: Field, sums: GradientSums | None = None) -> None:
        """``sums`` is for training; a field that is given without it must never change."""
        self._field = field
        self._sums = sums
        self._frozen = self._compiled() if sums is None else None

    def evaluate(self, points: NDArray[np.float32], gradient: bool) -> FieldValues:
        """The field at points [N, 3], metres from the region's centre; on the caller's thread."""
        field = self._frozen or self._compiled()
        return field_values(field, self._field.settings, points, gradient)

    def train(self, batch: Batch, rate: float, betas: Betas) -> float:
        """One optimiser step; returns the loss before it."""
        points = batch.points.numpy()
        targets = torch.sigmoid(batch.labels / self._field.settings.logit_scale_m).numpy()
        field = self._compiled()
        sums = self._sums
        assert sums is not None, "this engine is not for training"
        sums.begin(*field.features.shape)
        mlp_sums = [Mlp(*map(np.zeros_like, field.mlp)) for _ in range(THREADS)]
        counts = [0] * THREADS
        losses = [0.0] * THREADS

        def work(part: int) -> None:
            mine = slice(*share(len(points), part))
            counts[part], losses[part] = compiled_field.accumulate(
                points[mine],
                targets[mine],
                1.0 / len(points),
                field,
                mlp_sums[part],
                sums.features[part],
                sums.touched[part],
                sums.step,
            )

        MAPPING.each(work)
        how_far = rates(rate, betas)
        self._step_mlp(mlp_sums, how_far)
        moments = _moments(self._field.features)
        MAPPING.each(
            lambda part: step_touched(
                part, counts[part], sums.step, sums.touched, sums.features, moments, how_far
            ),
        )
        return sum(losses)

    def _step_mlp(self, sums: list[Mlp], how_far: Rates) -> None:
        for part, parameter in enumerate(self._field.mlp):
            gradient = np.sum([thread[part] for thread in sums], axis=0).reshape(1, -1)
            step_row(0, gradient, _moments(parameter), how_far)

    def _compiled(self) -> CompiledField:
        return make_field(
            self._field.settings,
            self._field.tree,
            self._field.features.values.numpy(),
            [part.values[0].numpy() for part in self._field.mlp],
            self._field.frequencies.numpy(),
        )


def _moments(parameter: Parameter) -> Moments:
    """A parameter as kernels take it: rows of numbers."""
    count = len(parameter)
    return Moments(
        parameter.values.numpy().reshape(count, -1),
        parameter.means.numpy().reshape(count, -1),
        parameter.variances.numpy().reshape(count, -1),
        parameter.steps.numpy(),
    )
