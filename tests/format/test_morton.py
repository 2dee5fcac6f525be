import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from triquad_format.records import morton


def slow_code(cell):
    code = 0
    for axis, coordinate in enumerate(cell):
        for bit in range(int(coordinate).bit_length()):
            code |= (int(coordinate) >> bit & 1) << (bit * len(cell) + axis)
    return code


@given(
    st.lists(st.integers(0, 2**31 - 1), min_size=2, max_size=2)
    | st.lists(st.integers(0, 2**20 - 1), min_size=3, max_size=3)
)
def test_codes_are_those_of_interleaved_bits(cell):
    code = int(morton.encode(np.array(cell)))
    assert code == slow_code(cell)
    assert morton.decode(np.array(code), len(cell)).tolist() == cell
