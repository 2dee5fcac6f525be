"""The field of one region while it grows and is trained: what it consists of, and its state."""

import math
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from triquad_format.records.field_settings import FieldSettings
from triquad_map.compiled.field.field import FieldArrays, FrozenCompiledField
from triquad_map.compiled.field.quadtree import FrozenQuadtree, LiveQuadtree
from triquad_map.composition.region import FieldEngine

from triquad_server.engine.parameter import Parameter
from triquad_server.engine.tensor_field import FieldTensors, TensorField


class StoredField(Protocol):
    """What a field consists of, whether it is live or frozen."""

    @property
    def settings(self) -> FieldSettings:
        """Its shape."""

    @property
    def tree(self) -> LiveQuadtree | FrozenQuadtree:
        """Its vertices."""

    @property
    def arrays(self) -> FieldArrays:
        """Its numbers; not to be written to."""


class FrozenField(FieldEngine, StoredField, Protocol):
    """A field that does not change any more. Safe for any thread."""


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
        generator: torch.Generator,
    ) -> None:
        """A field without vertices.

        Args:
            settings: its shape.
            frequencies: [m] of Fourier features, on coordinates normalised to [-1, 1].
            mlp: weights [in, out] and bias [out] of each layer in turn.
            generator: draws the feature vectors of new vertices.
        """
        self.settings = settings
        self.device = frequencies.device
        self.tree = LiveQuadtree(settings)
        # Row 0 stands for absent vertices, and stays zero.
        self.features = Parameter(torch.zeros((1, settings.feature_size), device=self.device))
        self.frequencies = frequencies
        self.mlp = [Parameter(part[None]) for part in mlp]
        self._generator = generator

    @property
    def vertices(self) -> int:
        """Vertices on all planes and levels."""
        return len(self.features) - 1

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

    def grow(self, leaves: NDArray[np.int64]) -> None:
        """Make room for surfaces in ``leaves`` [N, 3]; new feature vectors start at random.

        Leaves are int64 coordinates in ``[0, 2**depth)``, as evidence voxels.
        """
        if self.settings.encoding == "fourier":
            return
        size = (self.tree.grow(leaves), self.settings.feature_size)
        new = torch.randn(size, generator=self._generator, device=self.device)
        self.features.append(new * self.settings.feature_std)

    def restore(self, plane: int, h: int, codes: NDArray[np.int64], features: Tensor) -> None:
        """Add the vertices ``codes`` [V] of one level with their ``features`` [V, d]."""
        self.tree.restore(plane, h, codes)
        self.features.append(features)

    def freeze(self) -> FrozenField:
        """The field as it is now: compiled on the CPU, in tensors on other devices."""
        # The frequencies never change.
        values = self.tensors
        copied = FieldTensors(
            values.features.clone(), tuple(part.clone() for part in values.mlp), values.frequencies
        )
        tree = self.tree.freeze()
        if self.device.type == "cpu":
            return FrozenCompiledField(self.settings, tree, copied.arrays)
        return TensorField(self.settings, tree, copied)


def initial_field(settings: FieldSettings, device: torch.device, seed: int) -> LiveField:
    """A field of which nothing is learnt yet, drawn at random."""
    generator = torch.Generator(device).manual_seed(seed)
    frequencies = torch.randn(settings.frequencies, generator=generator, device=device)
    frequencies *= math.sqrt(settings.frequency_variance)
    # Uniform in +-1/sqrt(inputs), as those of torch.nn.Linear.
    hidden = settings.hidden
    mlp = []
    for inputs, outputs in ((settings.input_size, hidden), (hidden, hidden), (hidden, 1)):
        for size in ((inputs, outputs), (outputs,)):
            uniform = torch.rand(size, generator=generator, device=device) * 2 - 1
            mlp.append(uniform * (1 / math.sqrt(inputs)))
    return LiveField(settings, frequencies, mlp, generator)
