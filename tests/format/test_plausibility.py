"""Whether places are those of one sensor on its way."""

import numpy as np
import pytest
from triquad_format.records.plausibility import jumps


@pytest.mark.parametrize("seed", range(5))
def test_times_of_arrival_make_no_jumps_and_two_publishers_do(seed: int) -> None:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.02, 0.2, 60) * 1e9).astype(np.int64)
    places = np.stack([np.arange(60.0), rng.normal(0, 0.02, 60), np.full(60, 1.8)], axis=1)
    assert jumps(times, places) == (0, 0.0)
    places[::2, 1] += 0.4
    count, size_m = jumps(times, places)
    assert count > 30
    assert 0.35 < size_m < 0.6
