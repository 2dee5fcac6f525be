"""Adam (Kingma and Ba 2015, algorithm 1) for parameters of which a step touches some rows.

With its gradient ``g``, a row that takes its ``t``-th step changes by::

    mean     += (1 - mean_decay) * (g - mean)
    variance += (1 - variance_decay) * (g**2 - variance)
    m, v      = mean / (1 - mean_decay**t), variance / (1 - variance_decay**t)
    value    -= learning_rate * m / (sqrt(v) + EPSILON)

Steps are counted row by row, so that the moments of a row that is new or seldom touched are
corrected for its own age. Here the rule is in tensors, for any device;
:mod:`triquad_server.engine.compiled_adam` is the same rule for the CPU.
"""

from dataclasses import dataclass

from torch import Tensor

from triquad_server.engine.parameter import Parameter

EPSILON = 1e-10


@dataclass(frozen=True)
class Rates:
    """How fast values and moments follow the gradients."""

    learning_rate: float
    mean_decay: float  # in [0, 1), as is the next
    variance_decay: float


def step_rows(parameter: Parameter, rows: Tensor, gradient: Tensor, rates: Rates) -> None:
    """One step of ``rows`` [T], all different, along their ``gradient`` [T, ...]."""
    parameter.steps[rows] += 1
    means = parameter.means[rows].lerp_(gradient, 1 - rates.mean_decay)
    variances = parameter.variances[rows].lerp_(gradient.square(), 1 - rates.variance_decay)
    parameter.means[rows] = means
    parameter.variances[rows] = variances
    direction = _direction(means, variances, parameter.steps[rows], rates)
    parameter.values[rows] -= rates.learning_rate * direction


def step_where(parameter: Parameter, mask: Tensor, gradient: Tensor, rates: Rates) -> None:
    """As :func:`step_rows` for the rows where ``mask`` [rows] is set; ``gradient`` [rows, ...].

    It goes over all rows, but need not know how many are set, for which a GPU would have to be
    waited for.
    """
    parameter.steps.add_(mask)
    mask = mask.reshape(-1, *[1] * (gradient.dim() - 1))
    parameter.means.lerp_(gradient, (1 - rates.mean_decay) * mask)
    parameter.variances.lerp_(gradient.square(), (1 - rates.variance_decay) * mask)
    steps = parameter.steps.clamp(min=1)
    direction = _direction(parameter.means, parameter.variances, steps, rates)
    parameter.values.sub_(rates.learning_rate * mask * direction)


def _direction(means: Tensor, variances: Tensor, steps: Tensor, rates: Rates) -> Tensor:
    """What rows [R, ...] that took ``steps`` [R] lose at a learning rate of 1."""
    age = steps.to(means.dtype).reshape(-1, *[1] * (means.dim() - 1))
    mean = means / (1 - rates.mean_decay**age)
    deviation = (variances / (1 - rates.variance_decay**age)).sqrt_()
    return mean / (deviation + EPSILON)
