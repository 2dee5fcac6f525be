"""Cells of a lattice are told apart and found, however far apart they lie."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from triquad_format.records.cells import CellIndex, same_cells

COORDINATE = st.one_of(st.integers(-3, 3), st.integers(-(2**31), 2**31))
CELLS = st.lists(st.tuples(COORDINATE, COORDINATE, COORDINATE), max_size=30)


@given(CELLS)
def test_the_same_cells_have_one_number(listed: list[tuple[int, int, int]]) -> None:
    cells = np.array(listed, np.int64).reshape(-1, 3)
    first, number = same_cells(cells)
    assert len(first) == len(set(listed))
    np.testing.assert_array_equal(cells[first[number]], cells)


@given(CELLS, CELLS)
def test_a_cell_is_found_where_it_stands(
    listed: list[tuple[int, int, int]], wanted: list[tuple[int, int, int]]
) -> None:
    cells = list(dict.fromkeys(listed))
    wanted = wanted + listed
    index = CellIndex(np.array(cells, np.int64).reshape(-1, 3))
    rows = index.rows_of(np.array(wanted, np.int64).reshape(-1, 3))
    assert rows.tolist() == [cells.index(cell) if cell in cells else -1 for cell in wanted]
