"""What became of rays at a voxel is told on a coarse scale, and comes back within its steps."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from triquad_map.evidence.evidence import outcome_codes, outcome_counts

MOST_HITS = 8
STEP = 2**0.5 + 1e-9  # to the nearest power of two
COUNTS = st.integers(0, 2**31 - 1) | st.integers(0, 50)


def coded(hits: int, passes: int, misses: int) -> tuple[list[int], list[int]]:
    """The codes of counts, and the counts of these codes."""
    codes = outcome_codes(np.array([[hits, passes, misses]], np.int32))
    return codes[0].tolist(), outcome_counts(codes)[0].tolist()


@given(hits=st.integers(1, 2**31 - 1) | st.integers(1, 50), passes=COUNTS, misses=COUNTS)
def test_counts_come_back_within_a_step(hits: int, passes: int, misses: int) -> None:
    _, (have_hits, *have) = coded(hits, passes, misses)
    wanted = min(hits, MOST_HITS)
    assert wanted / STEP <= have_hits <= wanted * STEP
    for count, known in zip((passes, misses), have, strict=True):
        share = count / hits
        if share < 2**-3.5:
            assert known == 0
        elif share < 2**11:
            assert share / STEP <= known / have_hits <= share * STEP
        else:
            assert known == have_hits * 2**11


def test_a_wall_and_the_unknown_have_the_codes_0() -> None:
    for counts in ((8, 0, 0), (1000, 0, 0), (1000, 80, 3), (0, 0, 0)):
        assert coded(*counts) == ([0, 0, 0], [MOST_HITS, 0, 0])


def test_codes_that_are_written_come_back() -> None:
    counts = np.stack(np.meshgrid([1, 2, 4, 9], *[[0, 1, 2, 9, 70, 10**6]] * 2), -1).reshape(-1, 3)
    codes = outcome_codes(counts.astype(np.int32))
    np.testing.assert_array_equal(outcome_codes(outcome_counts(codes)), codes)
