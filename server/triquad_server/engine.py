"""Two engines for one field: tensors on any device, compiled code on the CPU."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from triquad_server import compiled_field
from triquad_server.adam import EPSILON, Betas
from triquad_server.compiled_adam import step_rows
from triquad_server.field import Field
from triquad_server.replay_pool import Batch
from triquad_server.threads import THREADS, split


@dataclass(frozen=True)
class FieldValues:
    """Signed distances [N] and, where asked for, their gradients [N, 3] (else [0, 3])."""

    sdf: NDArray[np.float32]
    gradient: NDArray[np.float32]


class Engine(Protocol):
    """What computes a field."""

    def evaluate(self, points: NDArray[np.float32], gradient: bool) -> FieldValues:
        """The field at points [N, 3], metres from the region's centre."""

    def train(self, batch: Batch, rate: float, betas: Betas) -> float:
        """One optimiser step; returns the loss before it."""


class GradientSums:
    """Room for the gradients of the feature rows, for each thread; all zero between steps.

    Engines that are not trained at the same time share it.
    """

    def __init__(self) -> None:
        self.features: tuple[NDArray[np.float32], ...] = ()  # per thread [rows, size]
        self.touched: tuple[NDArray[np.uint8], ...] = ()  # per thread [rows]

    def reserve(self, rows: int, size: int) -> None:
        """Make room for ``rows`` of ``size`` numbers."""
        if self.touched and len(self.touched[0]) >= rows and self.features[0].shape[1] == size:
            return
        room = rows + rows // 2
        self.features = tuple(np.zeros((room, size), np.float32) for _ in range(THREADS))
        self.touched = tuple(np.zeros(room, np.uint8) for _ in range(THREADS))


def make_engine(field: Field, sums: GradientSums | None = None) -> Engine:
    """The engine for a field: compiled code on the CPU, tensors elsewhere."""
    return CompiledEngine(field, sums) if field.device.type == "cpu" else TorchEngine(field)


class TorchEngine:
    """Tensors and automatic differentiation: the reference, on any device."""

    def __init__(self, field: Field) -> None:
        self._field = field

    def evaluate(self, points: NDArray[np.float32], gradient: bool) -> FieldValues:
        """The field at points [N, 3], metres from the region's centre."""
        tensor = torch.from_numpy(points).to(self._field.device)
        if gradient:
            value, slope = self._field.sdf_and_gradient(tensor)
            return FieldValues(value.cpu().numpy(), slope.cpu().numpy())
        with torch.no_grad():
            value = self._field.sdf(tensor)
        return FieldValues(value.cpu().numpy(), np.zeros((0, 3), np.float32))

    def train(self, batch: Batch, rate: float, betas: Betas) -> float:
        """One optimiser step; returns the loss before it."""
        return float(self._field.train(batch.points, batch.labels, rate, betas))


class CompiledEngine:
    """Compiled kernels over the field's own memory, on all cores."""

    def __init__(self, field: Field, sums: GradientSums | None = None) -> None:
        self._field = field
        self._sums = sums or GradientSums()

    def evaluate(self, points: NDArray[np.float32], gradient: bool) -> FieldValues:
        """The field at points [N, 3], metres from the region's centre."""
        geometry, index, decoder = self._geometry(), self._index(), self._decoder()
        features = self._field.features.values.numpy()
        logits = np.empty(len(points), np.float32)
        gradients = np.empty((len(points) if gradient else 0, 3), np.float32)

        def work(first: int, last: int) -> None:
            compiled_field.evaluate(
                points[first:last],
                features,
                geometry,
                index,
                decoder,
                logits[first:last],
                gradients[first:last],
            )

        split(len(points), work)
        scale = np.float32(self._field.settings.logit_scale_m)
        return FieldValues(logits * scale, gradients * scale)

    def train(self, batch: Batch, rate: float, betas: Betas) -> float:
        """One optimiser step; returns the loss before it."""
        field = self._field
        points = batch.points.numpy()
        targets = torch.sigmoid(batch.labels / field.settings.logit_scale_m).numpy()
        geometry, index, decoder = self._geometry(), self._index(), self._decoder()
        features = field.features.values.numpy()
        self._sums.reserve(*features.shape)
        sums = [_zeros_like(decoder) for _ in range(THREADS)]
        losses = np.zeros(THREADS)

        def work(first: int, last: int) -> None:
            part = first * THREADS // len(points)
            losses[part] = compiled_field.accumulate(
                points[first:last],
                targets[first:last],
                1.0 / len(points),
                features,
                geometry,
                index,
                decoder,
                sums[part],
                self._sums.features[part],
                self._sums.touched[part],
            )

        split(len(points), work)
        self._step_decoder(sums, rate, betas)
        self._step_features(rate, betas)
        return float(losses.sum())

    def _step_decoder(
        self,
        sums: list[compiled_field.Decoder],
        rate: float,
        betas: Betas,
    ) -> None:
        only = torch.zeros(1, dtype=torch.int64)
        for part, parameter in enumerate(self._field.mlp):
            total = np.sum([thread[part] for thread in sums], axis=0)
            gradient = torch.from_numpy(np.ascontiguousarray(total.T))
            parameter.step(only, gradient.reshape(parameter.values.shape), rate, betas)

    def _step_features(self, rate: float, betas: Betas) -> None:
        features = self._field.features
        values, means = features.values.numpy(), features.means.numpy()
        variances, steps = features.variances.numpy(), features.steps.numpy()
        touched, sums = self._sums.touched, self._sums.features

        def work(first: int, last: int) -> None:
            step_rows(
                first,
                last,
                touched,
                sums,
                values,
                means,
                variances,
                steps,
                rate,
                betas.mean,
                betas.variance,
                EPSILON,
            )

        split(len(values), work)

    def _geometry(self) -> compiled_field.Geometry:
        settings = self._field.settings
        return compiled_field.Geometry(
            np.float32(settings.leaf_m),
            np.float32(1 << (settings.depth - 1)),
            settings.feature_levels if settings.encoding != "fourier" else 0,
            1 << settings.levels[0],
        )

    def _index(self) -> compiled_field.Index:
        tree = self._field.tree
        return compiled_field.Index(
            tree.blocks.keys.numpy(),
            tree.blocks.rows.numpy(),
            tree.blocks.shift,
            tree.block_rows.numpy(),
            np.array(tree.starts, np.int64),
        )

    def _decoder(self) -> compiled_field.Decoder:
        settings = self._field.settings
        arrays = [np.ascontiguousarray(part.values[0].numpy().T) for part in self._field.mlp]
        turns = self._field.frequencies.numpy() / np.float32(settings.region_side_m / 2)
        if settings.encoding == "features":
            turns = turns[:0]
        w1, b1, w2, b2, w3, b3 = arrays
        return compiled_field.Decoder(w1, b1, w2, b2, w3.reshape(-1), b3, turns)


def _zeros_like(decoder: compiled_field.Decoder) -> compiled_field.Decoder:
    return compiled_field.Decoder(*(np.zeros_like(array) for array in decoder))
