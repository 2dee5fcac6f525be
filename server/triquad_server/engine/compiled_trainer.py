"""Training in compiled code, on all cores of the CPU."""

import numpy as np
import torch
from numpy.typing import NDArray
from triquad_map.compiled.field.field import Touched, accumulate, make_field
from triquad_map.compiled.field.mlp import Mlp
from triquad_map.compiled.team import THREADS, Team, share

from triquad_server.engine.adam import Rates
from triquad_server.engine.batch import Batch
from triquad_server.engine.compiled_adam import (
    CompiledRates,
    compiled_rates,
    parameter_rows,
    step_row,
    step_touched,
)
from triquad_server.engine.live_field import LiveField

_LAST_STEP = 2**31 - 1


class GradientSums:
    """Room for the gradients of the feature rows, for each thread; all but row 0 are zero between
    steps.

    Trainers that do not train at the same time share it.
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


class CompiledTrainer:
    """Trains a field in its own memory, which is the CPU's."""

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
            ),
        )
