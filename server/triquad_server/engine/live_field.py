"""The field of one region while it grows and is trained."""

import math
from dataclasses import dataclass

import numpy as np
from triquad_format.records.arrays import Floats, Ints, Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_map.field.field import FieldArrays
from triquad_map.field.frozen_field import FrozenField
from triquad_map.field.quadtree import LiveQuadtree

from triquad_server.engine.initial_mlp import initial_mlp
from triquad_server.engine.memory import FieldNumbers, Memory, Rows

_SPARE = 4  # one spare row for each N rows, when rows are copied to larger arrays


class Parameter:
    """Rows of trained values with the optimiser's state of each; growing keeps both together.

    All four are views of the rows in use, which the optimiser changes in place; the values after
    :meth:`thaw`.
    """

    def __init__(self, values: Floats, memory: Memory) -> None:
        """Copy ``values`` [rows, ...]; no steps are taken yet."""
        self._memory = memory
        self.values: Rows = memory.put(values)
        self.means: Rows = memory.put(np.zeros_like(values))  # running means of the gradients
        self.variances: Rows = memory.put(np.zeros_like(values))  # and of the squared gradients
        self.steps: Rows = memory.put(np.zeros(len(values), np.int32))  # [rows]
        self._room: tuple[Rows, ...] = (self.values, self.means, self.variances, self.steps)
        self._is_frozen = False

    def __len__(self) -> int:
        return len(self.values)

    def append(self, values: Floats) -> None:
        """Add rows [N, ...] that took no step yet; the state of the others stays."""
        used, count = len(self), len(self) + len(values)
        room = tuple(
            rows if count <= len(rows) else self._with_room(rows, count) for rows in self._room
        )
        room[0][used:count] = self._memory.put(values)
        for state in room[1:]:
            state[used:count] = 0
        self._is_frozen = self._is_frozen and room[0] is self._room[0]
        self._room = room
        self.values, self.means, self.variances, self.steps = (rows[:count] for rows in room)

    def freeze(self) -> Rows:
        """Return the values as they are now; they are copied before they change."""
        self._is_frozen = True
        return self.values

    def thaw(self) -> None:
        """Make the values changeable in place, as a copy of those that are frozen."""
        if self._is_frozen:
            values = self._with_room(self.values, len(self))
            self._room = (values, *self._room[1:])
            self.values = values[: len(self)]
            self._is_frozen = False

    def restore(self, means: Floats, variances: Floats, steps: Ints) -> None:
        """Take over optimiser state, shaped as this parameter's."""
        self.means[:] = self._memory.put(means)
        self.variances[:] = self._memory.put(variances)
        self.steps[:] = self._memory.put(steps)

    def _with_room(self, rows: Rows, count: int) -> Rows:
        """Return a copy of the ``rows`` in use, with room for ``count`` and some more.

        It is small, since each epoch that was trained has its own, and on a device takes it.
        """
        roomy = self._memory.room(count + count // _SPARE, rows)
        roomy[: len(self)] = rows[: len(self)]
        return roomy


@dataclass(frozen=True)
class Batch:
    """Samples that one step of training learns from."""

    points: Rows  # [B, 3] metres from the region's centre
    labels: Rows  # [B] signed distances, metres


_SOFT_STEPS, _HARDEST = 800, 0.1
"""The steps for which a row of features learns at the full rate (after n times as many, at an n-th
of it), and the least share of the rate. So learnt values move little where others are trained. Of
the MLP, which all places of a region share, it is the square."""

LAST_AGE = int(_SOFT_STEPS / _HARDEST)  # from here on, no rate falls any more
AGES = np.arange(1.0, LAST_AGE + 1)


def rate_share(ages: Rows) -> Rows:
    """Return the share of the learning rate of rows that took ``ages`` steps, one at least."""
    return (_SOFT_STEPS / ages).clip(_HARDEST, 1)


class LiveField:
    """Vertices with their feature vectors, the MLP and the Fourier frequencies of a region.

    One thread owns it: that one grows it, and trains it through a trainer. All numbers are in one
    memory.
    """

    def __init__(
        self,
        settings: FieldSettings,
        frequencies: Floats,
        mlp: list[Floats],
        mlp_steps: int,
        generator: np.random.Generator,
        memory: Memory,
    ) -> None:
        """Make a field without vertices.

        Args:
            settings: its shape.
            frequencies: [m] of Fourier features, on coordinates normalised to [-1, 1].
            mlp: weights [in, out] and bias [out] of each layer in turn.
            mlp_steps: steps that the MLP has taken already; with moments of zero, the first few
                of an old one are up to twice as large.
            generator: draws the feature vectors of new vertices.
            memory: where all numbers are copied to.
        """
        self.settings = settings
        self.memory = memory
        self.tree = LiveQuadtree(settings)
        # Row 0 stands for absent vertices, and stays zero.
        self.features = Parameter(np.zeros((1, settings.feature_size), np.float32), memory)
        self.mlp = [Parameter(part[None], memory) for part in mlp]
        for part in self.mlp:
            part.steps[:] = mlp_steps
        self.mlp_steps = mlp_steps  # to read its own from a GPU would have to wait for it
        self.version = 0  # rises with each step of training
        self._frequencies = memory.put(frequencies)
        self._generator = generator

    @property
    def vertices(self) -> int:
        """The number of vertices on all planes and levels."""
        return len(self.features) - 1

    @property
    def numbers(self) -> FieldNumbers:
        """The numbers of the field as they are now; they change with it, until it is thawed."""
        mlp = tuple(part.values[0] for part in self.mlp)
        return FieldNumbers(self.features.values, mlp, self._frequencies)

    @property
    def arrays(self) -> FieldArrays:
        """The numbers as arrays; where the field is in arrays, those of :attr:`numbers`."""
        features, mlp, frequencies = self.numbers
        array = self.memory.array
        return FieldArrays(array(features), tuple(map(array, mlp)), array(frequencies))

    def grow(self, leaves: Longs) -> None:
        """Make room for surfaces in ``leaves`` [N, 3]; new feature vectors start at random.

        Leaves are int64 coordinates in ``[0, 2**depth)``, as evidence voxels.
        """
        if self.settings.encoding == "fourier":
            return
        size = (self.tree.grow(leaves), self.settings.feature_size)
        new = self._generator.standard_normal(size, np.float32)
        new *= self.settings.feature_std
        self.features.append(new)

    def growth_by(self, leaves: Longs) -> int:
        """Return the most vertices that :meth:`grow` would add: all those of the ``leaves``."""
        return (
            0 if self.settings.encoding == "fourier" else LiveQuadtree(self.settings).grow(leaves)
        )

    def restore(self, plane: int, h: int, codes: Longs, features: Floats) -> None:
        """Add the vertices ``codes`` [V] of one level with their ``features`` [V, d]."""
        self.tree.restore(plane, h, codes)
        self.features.append(features)

    def next_mlp_share(self) -> float:
        """Count a step of the MLP; return its share of what features of its age learn at."""
        self.mlp_steps += 1
        return min(1.0, max(_HARDEST, _SOFT_STEPS / self.mlp_steps))

    def live_view(self) -> FrozenField:
        """Return the field for its thread alone; from arrays, it is valid until it changes."""
        return FrozenField(self.settings, self.tree.freeze(), self.arrays)

    def freeze(self) -> FrozenField:
        """Return the field as it is now; in arrays, both share numbers until this one changes.

        Compiled code answers wherever the field is trained: for the few thousand points of most
        questions it takes less time than a GPU.
        """
        for part in (self.features, *self.mlp):
            part.freeze()
        return self.live_view()

    def thaw(self) -> None:
        """Before a step, make numbers of its own, which may be changed in place."""
        self.version += 1
        for parameter in (self.features, *self.mlp):
            parameter.thaw()


def initial_field(settings: FieldSettings, memory: Memory, seed: int) -> LiveField:
    """Return an untrained field: random, but for its MLP (:func:`initial_mlp`)."""
    generator = np.random.default_rng(seed)
    frequencies = generator.standard_normal(settings.frequencies, np.float32)
    frequencies *= np.float32(math.sqrt(settings.frequency_variance))
    mlp, steps = initial_mlp(settings, generator)
    return LiveField(settings, frequencies, mlp, steps, generator, memory)
