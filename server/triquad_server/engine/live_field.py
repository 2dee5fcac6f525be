"""The field of one region while it grows and is trained, and the plain arrays of its record."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from triquad_format.records.arrays import Bools, Doubles, Floats, Longs
from triquad_format.records.field_settings import FieldSettings, RegionIndex
from triquad_format.records.region import AXES, Mlp, Region, TrainingState, VertexTable
from triquad_format.records.replay_rays import ReplayRays
from triquad_map.compiled.evidence.evidence import FrozenEvidence
from triquad_map.compiled.evidence.live_evidence import LiveEvidence
from triquad_map.compiled.field.field import FieldArrays
from triquad_map.compiled.field.frozen_field import FrozenCompiledField
from triquad_map.compiled.field.quadtree import LiveQuadtree

from triquad_server.engine.initial_mlp import initial_mlp
from triquad_server.engine.tensor_field import FieldTensors, TensorField

FrozenField = FrozenCompiledField | TensorField
"""A field that does not change any more. Safe for any thread."""


_VARIANCE_BITS = 3  # that follow the first, in a checkpoint


class Parameter:
    """Rows of trained values with the optimiser's state of each; growing keeps both together.

    All four tensors are views of the rows in use, which the optimiser changes in place.
    """

    def __init__(self, values: Tensor) -> None:
        """Begin with ``values`` [rows, ...], which are copied, and no steps taken."""
        self.values = values.clone()
        self.means = torch.zeros_like(values)  # running means of the gradients
        self.variances = torch.zeros_like(values)  # running means of the squared gradients
        self.steps = torch.zeros(len(values), dtype=torch.int32, device=values.device)  # [rows]
        self._room: tuple[Tensor, ...] = (self.values, self.means, self.variances, self.steps)

    def __len__(self) -> int:
        return len(self.values)

    def append(self, values: Tensor) -> None:
        """Add rows [N, ...] that took no step yet; the state of the others stays."""
        used, count = len(self), len(self) + len(values)
        if count > len(self._room[0]):
            capacity = max(count, 2 * len(self._room[0]))
            self._room = tuple(_with_room(rows, capacity) for rows in self._room)
        self._room[0][used:count] = values
        for state in self._room[1:]:
            state[used:count] = 0
        self.values, self.means, self.variances, self.steps = (rows[:count] for rows in self._room)

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


@dataclass(frozen=True)
class Batch:
    """Samples that one step of training learns from."""

    points: Tensor  # [B, 3] metres from the region's centre
    labels: Tensor  # [B] signed distances, metres


AgesT = TypeVar("AgesT", Doubles, Tensor)  # [N], or of any shape


class Rates(NamedTuple):
    """How fast values and moments follow the gradients."""

    learning_rate: float
    mean_decay: float  # in [0, 1), as is the next
    variance_decay: float
    young_rate: float
    """The learning rate of rows that took few steps yet; at least that of the others."""

    def by_age(self, ages: AgesT) -> AgesT:
        """The learning rates, shaped as ``ages``, of rows that took so many steps: one at least."""
        shares = (_SOFT_STEPS / ages).clip(_HARDEST, 1)
        young = (_YOUNG_STEPS / ages).clip(0, 1) ** 2
        return self.learning_rate * shares + (self.young_rate - self.learning_rate) * young


_SOFT_STEPS, _HARDEST = 800, 0.1
"""For so many steps a row of features learns at the full rate; after n times as many at an n-th of
it, and at this share at least. What is learnt hardens, and moves little where others are."""

LAST_AGE = int(_SOFT_STEPS / _HARDEST)  # from here on, no rate falls any more

_YOUNG_STEPS = 200
"""For so many steps a row learns at the rate of young ones; after n times as many, what is above
the others' rate is down to ``1 / n**2`` of it."""

_MLP_SOFT_STEPS, _MLP_HARDEST = 300, 0.02
"""The MLP does so, and in addition so: all places of a region share it."""


class LiveField:
    """Vertices with their feature vectors, the MLP and the Fourier frequencies of a region.

    One thread owns it: that one grows it, and trains it through a trainer. All tensors are on one
    device.
    """

    def __init__(
        self,
        settings: FieldSettings,
        frequencies: Tensor,
        mlp: list[Tensor],
        mlp_steps: int,
        generator: torch.Generator,
    ) -> None:
        """A field without vertices.

        Args:
            settings: its shape.
            frequencies: [m] of Fourier features, on coordinates normalised to [-1, 1].
            mlp: weights [in, out] and bias [out] of each layer in turn.
            mlp_steps: that the MLP counts as having taken; with moments of zero, the first few of
                an old one are up to twice as large.
            generator: draws the feature vectors of new vertices.
        """
        self.settings = settings
        self.device = frequencies.device
        self.tree = LiveQuadtree(settings)
        # Row 0 stands for absent vertices, and stays zero.
        self.features = Parameter(torch.zeros((1, settings.feature_size), device=self.device))
        self.frequencies = frequencies
        self.mlp = [Parameter(part[None]) for part in mlp]
        for part in self.mlp:
            part.steps.fill_(mlp_steps)
        self.mlp_steps = mlp_steps  # to read its own from a GPU would take a wait
        self.held: Tensor | None = None
        """Which of the first rows of features [N] stay as they are, as does the MLP; None: none."""

        self._vertices_held = 0
        self._generator = generator

    @property
    def vertices(self) -> int:
        """Vertices on all planes and levels."""
        return len(self.features) - 1

    @property
    def vertices_that_learn(self) -> int:
        """All but those that are held."""
        return self.vertices - self._vertices_held

    @property
    def parameters(self) -> int:
        """Learnable numbers."""
        features = self.vertices * self.settings.feature_size
        return features + sum(part.values.numel() for part in self.mlp)

    @property
    def tensors(self) -> FieldTensors:
        """The numbers of the field as they are now; they change with it."""
        mlp = tuple(part.values[0] for part in self.mlp)
        return FieldTensors(self.features.values, mlp, self.frequencies)

    @property
    def arrays(self) -> FieldArrays:
        """The numbers as arrays, which share memory with the field where it is on the CPU."""
        return self.tensors.arrays

    def grow(self, leaves: Longs) -> None:
        """Make room for surfaces in ``leaves`` [N, 3]; new feature vectors start at random.

        Leaves are int64 coordinates in ``[0, 2**depth)``, as evidence voxels.
        """
        if self.settings.encoding == "fourier":
            return
        size = (self.tree.grow(leaves), self.settings.feature_size)
        new = torch.randn(size, generator=self._generator, device=self.device)
        self.features.append(new * self.settings.feature_std)

    def growth_by(self, leaves: Longs) -> int:
        """How many vertices :meth:`grow` would add."""
        return 0 if self.settings.encoding == "fourier" else self.tree.growth_by(leaves)

    def restore(self, plane: int, h: int, codes: Longs, features: Tensor) -> None:
        """Add the vertices ``codes`` [V] of one level with their ``features`` [V, d]."""
        self.tree.restore(plane, h, codes)
        self.features.append(features)

    def next_mlp_share(self) -> float:
        """Count a step of the MLP; the share of the rates in it: it hardens more than features."""
        self.mlp_steps += 1
        return min(1.0, max(_MLP_HARDEST, _MLP_SOFT_STEPS / self.mlp_steps))

    def live_view(self) -> FrozenField:
        """The field in its own memory: for its thread alone, and of use until it changes."""
        return self._answering_from(self.tensors)

    def hold(self, rows: Bools | None) -> None:
        """From now on, the feature ``rows`` [N] and the MLP stay as they are; None: all learns.

        Rows that are added later learn.
        """
        self.held = None if rows is None else torch.from_numpy(rows).to(self.device)
        self._vertices_held = 0 if rows is None else int(rows[1:].sum())

    def freeze(self) -> FrozenField:
        """The field as it is now, in memory of its own."""
        now = self.tensors  # of which the frequencies never change
        clones = tuple(part.clone() for part in now.mlp)
        return self._answering_from(FieldTensors(now.features.clone(), clones, now.frequencies))

    def _answering_from(self, tensors: FieldTensors) -> FrozenField:
        """Compiled on the CPU, in tensors on other devices."""
        tree = self.tree.freeze()
        if self.device.type == "cpu":
            return FrozenCompiledField(self.settings, tree, tensors.arrays)
        return TensorField(self.settings, tree, tensors)


def initial_field(settings: FieldSettings, device: torch.device, seed: int) -> LiveField:
    """A field of which nothing is learnt yet: random, but for its MLP (:func:`initial_mlp`)."""
    generator = torch.Generator(device).manual_seed(seed)
    frequencies = torch.randn(settings.frequencies, generator=generator, device=device)
    frequencies *= math.sqrt(settings.frequency_variance)
    mlp, steps = initial_mlp(settings, generator)
    return LiveField(settings, frequencies, mlp, mlp_steps=steps, generator=generator)


def region_record(
    index: RegionIndex,
    field: LiveField | FrozenField,
    evidence: FrozenEvidence | LiveEvidence,
    training: TrainingState | None,
) -> Region:
    """A region as plain arrays that share nothing with ``field`` and ``evidence``."""
    arrays = field.arrays
    tables = []
    for plane in range(len(AXES)):
        for h, level in enumerate(field.settings.levels):
            codes, rows = field.tree.table(plane, h)
            tables.append(VertexTable(plane, level, codes, features=arrays.features[rows]))
    mlp = [part.copy() for part in arrays.mlp]
    return Region(
        index=index,
        frequencies=arrays.frequencies.copy(),
        mlp=Mlp(tuple(mlp[0::2]), tuple(mlp[1::2])),
        tables=tuple(tables),
        evidence=evidence.record(),
        training=training,
    )


def training_state(
    field: LiveField, *, rays: ReplayRays, samples: Batch, budget_samples: int
) -> TrainingState:
    """What training needs beyond the field itself, sharing nothing with it.

    Of the vertices' moments the means are left out, which forget in some ten steps, and the
    variances are rounded: that changes steps by at most 3 %, and takes a seventh of the bytes.

    Args:
        field: whose optimiser state is copied.
        rays: that are to be trained on again.
        samples: likewise, of what no ray tells.
        budget_samples: how many samples are still to be trained on.
    """
    features, size = field.features, field.settings.feature_size
    rows = [
        torch.from_numpy(field.tree.table(plane, h)[1])
        for plane in range(len(AXES))
        for h in range(field.settings.feature_levels)
    ]
    mlp = field.mlp[0::2] + field.mlp[1::2]
    return TrainingState(
        table_means=tuple(np.zeros((len(chosen), size), np.float32) for chosen in rows),
        table_variances=tuple(_rounded(_array(features.variances[chosen])) for chosen in rows),
        table_steps=tuple(_array(features.steps[chosen]) for chosen in rows),
        mlp_means=tuple(_array(part.means[0]) for part in mlp),
        mlp_variances=tuple(_array(part.variances[0]) for part in mlp),
        mlp_steps=field.mlp_steps,
        sample_points=_array(samples.points),
        sample_labels=_array(samples.labels).astype(np.float16),
        budget_samples=budget_samples,
        rays=rays,
    )


def field_from_record(
    record: Region, settings: FieldSettings, device: torch.device, seed: int
) -> LiveField:
    """A field that answers as the recorded one and goes on training where it stopped."""
    layers = zip(record.mlp.weights, record.mlp.biases, strict=True)
    field = LiveField(
        settings,
        _tensor(record.frequencies, device),
        [_tensor(array, device) for layer in layers for array in layer],
        # Without training state nothing tells how much it learnt.
        mlp_steps=0 if record.training is None else record.training.mlp_steps,
        generator=torch.Generator(device).manual_seed(seed),
    )
    for table in record.tables:
        h = table.level - settings.levels[0]
        features = _tensor(table.vectors(), device)
        field.restore(table.plane, h, table.codes.astype(np.int64), features=features)
    if record.training is not None:
        _restore_optimiser(field, record.training)
    return field


def _restore_optimiser(field: LiveField, state: TrainingState) -> None:
    device = field.device
    zero = torch.zeros((1, field.settings.feature_size), device=device)
    means = [_tensor(part.astype(np.float32), device) for part in state.table_means]
    variances = [_tensor(part.astype(np.float32), device) for part in state.table_variances]
    steps = [_tensor(part, device) for part in state.table_steps]
    field.features.restore(
        torch.cat([zero, *means]),
        torch.cat([zero, *variances]),
        torch.cat([zero[:, 0].int(), *steps]),
    )
    mlp = field.mlp[0::2] + field.mlp[1::2]
    for part, mean, variance in zip(mlp, state.mlp_means, state.mlp_variances, strict=True):
        taken = torch.full((1,), state.mlp_steps, dtype=torch.int32, device=device)
        part.restore(_tensor(mean, device)[None], _tensor(variance, device)[None], taken)


def _rounded(values: Floats) -> Floats:
    """Positive ``values`` to four significant bits; the other bits are 0, and take no room."""
    dropped = 23 - _VARIANCE_BITS
    bits = values.view(np.int32) + (1 << dropped - 1)
    rounded: Floats = (bits >> dropped << dropped).view(np.float32)
    return rounded


def _array(tensor: Tensor) -> NDArray[Any]:
    return np.array(tensor.detach().cpu().numpy())


def _tensor(array: NDArray[Any], device: torch.device) -> Tensor:
    return torch.tensor(array, device=device)
