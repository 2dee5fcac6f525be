"""Rows of trained values, and the optimiser's state of each."""

import torch
from torch import Tensor


class Parameter:
    """Values with the state of :mod:`triquad_server.engine.adam`; growing keeps both together.

    All four tensors are views of the rows in use, which the optimiser changes in place.
    """

    def __init__(self, values: Tensor) -> None:
        """Begin with ``values`` [rows, ...], which are copied, and no steps taken."""
        self._count = len(values)
        self._values = values.clone()
        self._means = torch.zeros_like(values)
        self._variances = torch.zeros_like(values)
        self._steps = torch.zeros(len(values), dtype=torch.int32, device=values.device)

    def __len__(self) -> int:
        return self._count

    @property
    def values(self) -> Tensor:
        """The parameter [rows, ...]."""
        return self._values[: self._count]

    @property
    def means(self) -> Tensor:
        """Running means of the gradients, shaped as ``values``."""
        return self._means[: self._count]

    @property
    def variances(self) -> Tensor:
        """Running means of the squared gradients, shaped as ``values``."""
        return self._variances[: self._count]

    @property
    def steps(self) -> Tensor:
        """Steps that each row took [rows] int32."""
        return self._steps[: self._count]

    def append(self, values: Tensor) -> None:
        """Add rows that took no step yet; the state of the others stays."""
        count = self._count + len(values)
        if count > len(self._values):
            capacity = max(count, 2 * len(self._values))
            self._values = _with_room(self._values, capacity)
            self._means = _with_room(self._means, capacity)
            self._variances = _with_room(self._variances, capacity)
            self._steps = _with_room(self._steps, capacity)
        new = slice(self._count, count)
        self._values[new] = values
        for state in (self._means, self._variances, self._steps):
            state[new] = 0
        self._count = count

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
