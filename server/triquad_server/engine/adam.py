"""Adam for parameters of which a step touches some rows (Kingma and Ba 2015, algorithm 1)."""

from dataclasses import dataclass

import torch
from torch import Tensor

EPSILON = 1e-10


@dataclass(frozen=True)
class Betas:
    """Decay rates of the two moments."""

    mean: float
    variance: float


class Parameter:
    """Rows of values with their optimiser state; growing keeps both together.

    ``steps`` counts the steps of each row, so that the moments of a row that is new or seldom
    touched are corrected for its own age.
    """

    def __init__(self, values: Tensor) -> None:
        self._count = len(values)
        self._values = values.clone()
        self._means = torch.zeros_like(values)
        self._variances = torch.zeros_like(values)
        self._steps = torch.zeros(len(values), dtype=torch.int32, device=values.device)

    def __len__(self) -> int:
        return self._count

    @property
    def values(self) -> Tensor:
        """The parameter [rows, ...]; a view that :meth:`step` changes in place."""
        return self._values[: self._count]

    @property
    def means(self) -> Tensor:
        """First moments, shaped as ``values``."""
        return self._means[: self._count]

    @property
    def variances(self) -> Tensor:
        """Second moments, shaped as ``values``."""
        return self._variances[: self._count]

    @property
    def steps(self) -> Tensor:
        """Steps that each row took [rows] int32."""
        return self._steps[: self._count]

    def snapshot(self) -> "Parameter":
        """A copy of the values for reading, without optimiser state."""
        twin = Parameter(self.values[:0])
        twin._count, twin._values = self._count, self.values.clone()
        return twin

    def append(self, values: Tensor) -> None:
        """Add rows with fresh optimiser state; that of the others stays."""
        count = self._count + len(values)
        if count > len(self._values):
            capacity = max(count, 2 * len(self._values))
            self._values = _grown(self._values, capacity)
            self._means = _grown(self._means, capacity)
            self._variances = _grown(self._variances, capacity)
            self._steps = _grown(self._steps, capacity)
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

    def step_where(self, mask: Tensor, gradient: Tensor, rate: float, betas: Betas) -> None:
        """As :meth:`step` for the rows where ``mask`` [rows] is set; ``gradient`` [rows, ...].

        It goes over all rows, but need not know how many are set, for which a GPU would have to be
        waited for.
        """
        self.steps.add_(mask)
        mask = mask.reshape(-1, *[1] * (gradient.dim() - 1))
        self.means.lerp_(gradient, (1 - betas.mean) * mask)
        self.variances.lerp_(gradient.square(), (1 - betas.variance) * mask)
        move = _move(self.means, self.variances, self.steps.clamp(min=1), betas)
        self.values.sub_(rate * mask * move)

    def step(self, rows: Tensor, gradient: Tensor, rate: float, betas: Betas) -> None:
        """One step of ``rows`` [T] along ``gradient`` [T, ...] at a learning ``rate``."""
        self._steps[rows] += 1
        means = self._means[rows].lerp_(gradient, 1 - betas.mean)
        variances = self._variances[rows].lerp_(gradient.square(), 1 - betas.variance)
        self._means[rows] = means
        self._variances[rows] = variances
        self._values[rows] -= rate * _move(means, variances, self._steps[rows], betas)


def _move(means: Tensor, variances: Tensor, steps: Tensor, betas: Betas) -> Tensor:
    """How far rows [R, ...] of an age of ``steps`` [R] go, at a learning rate of 1."""
    age = steps.to(means.dtype).reshape(-1, *[1] * (means.dim() - 1))
    mean = means / (1 - betas.mean**age)
    deviation = (variances / (1 - betas.variance**age)).sqrt_()
    return mean / (deviation + EPSILON)


def _grown(tensor: Tensor, capacity: int) -> Tensor:
    # What nothing has been written to takes no memory.
    grown = tensor.new_empty((capacity, *tensor.shape[1:]))
    grown[: len(tensor)] = tensor
    return grown
