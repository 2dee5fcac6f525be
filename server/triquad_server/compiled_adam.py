"""Adam in compiled code: the step of :mod:`triquad_server.adam`, on the rows that were touched."""

import numba
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


@numba.njit(cache=True, nogil=True, fastmath=True)
def step_rows(
    first: int,
    last: int,
    touched: tuple[NDArray[np.uint8], ...],
    sums: tuple[Floats, ...],
    values: Floats,
    means: Floats,
    variances: Floats,
    steps: NDArray[np.int32],
    rate: float,
    beta1: float,
    beta2: float,
    epsilon: float,
) -> None:
    """Adam on the touched rows in ``[first, last)``; clears their sums and marks."""
    size = values.shape[1]
    log_beta1, log_beta2 = np.log(beta1), np.log(beta2)
    for row in range(first, last):
        any_touched = False
        for part in range(len(touched)):
            any_touched = any_touched or touched[part][row] != 0
        if not any_touched:
            continue
        for part in range(1, len(touched)):
            if touched[part][row]:
                for k in range(size):
                    sums[0][row, k] += sums[part][row, k]
                    sums[part][row, k] = 0
        steps[row] += 1
        # beta ** steps: the power itself compiles to a function that LLVM's runtime lacks here.
        mean_scale = np.float32(rate / (1 - np.exp(steps[row] * log_beta1)))
        variance_scale = np.float32(1 / (1 - np.exp(steps[row] * log_beta2)))
        for k in range(size):
            g = sums[0][row, k]
            sums[0][row, k] = 0
            means[row, k] += np.float32(1 - beta1) * (g - means[row, k])
            variances[row, k] += np.float32(1 - beta2) * (g * g - variances[row, k])
            deviation = np.sqrt(variances[row, k] * variance_scale) + np.float32(epsilon)
            values[row, k] -= mean_scale * means[row, k] / deviation
        for part in range(len(touched)):
            touched[part][row] = 0
