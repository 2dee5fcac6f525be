"""A grid goes to the server in blocks, and comes back as one."""

import numpy as np
import pytest
from triquad_client.calls.questions import _blocks
from triquad_format.wire.limits import MAX_SEARCHES


@pytest.mark.parametrize(
    "counts", [(1, 1, 1), (300, 200, 1), (7, 150, 200), (3, 1, MAX_SEARCHES), (2, MAX_SEARCHES, 1)]
)
def test_blocks_are_all_cells_once_in_their_order_and_none_is_too_large(counts):
    cells = np.arange(np.prod(counts)).reshape(counts)
    parts = []
    for block in _blocks(counts):
        ends = np.array(block.first) + block.counts
        part = cells[tuple(slice(*ends) for ends in zip(block.first, ends, strict=True))]
        assert part.shape == block.counts
        assert part.size <= MAX_SEARCHES
        parts.append(part.ravel())
    np.testing.assert_array_equal(np.concatenate(parts), cells.ravel())
