"""Cells are found in a few steps, however they lie."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from triquad_map.compiled.voxel_index import (
    CELL_LIMIT,
    VoxelIndex,
    cells_of,
    keys_of,
    longest_probe,
)

COORDINATE = st.integers(-CELL_LIMIT, CELL_LIMIT - 1)


@given(st.lists(st.tuples(COORDINATE, COORDINATE, COORDINATE), min_size=1))
def test_a_key_tells_its_cell(cells: list[tuple[int, int, int]]) -> None:
    given_cells = np.array(cells)
    assert (cells_of(keys_of(given_cells)) == given_cells).all()


@pytest.mark.parametrize("normal", range(3))
@pytest.mark.parametrize("spacing", [1, 2, 8])
def test_walls_of_cells_are_found_in_a_few_steps(normal: int, spacing: int) -> None:
    side = 180
    cells = np.zeros((side * side, 3), np.int64)
    along = [axis for axis in range(3) if axis != normal]
    cells[:, along] = np.stack(np.divmod(np.arange(side * side), side), axis=1) * spacing
    index = VoxelIndex.of_cells(cells - 50)
    assert (index.cells() == cells - 50).all()
    assert longest_probe(index.arrays) <= 6
