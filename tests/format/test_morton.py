import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from triquad_format.records import morton


def slow_code(cell):
    code = 0
    for axis, coordinate in enumerate(cell):
        for bit in range(int(coordinate).bit_length()):
            code |= (int(coordinate) >> bit & 1) << (bit * len(cell) + axis)
    return code


@pytest.mark.parametrize(("dimensions", "bits"), [(2, 31), (3, 20)])
def test_known_codes(dimensions, bits):
    units = np.eye(dimensions, dtype=np.int64)
    assert morton.encode(units).tolist() == [1 << axis for axis in range(dimensions)]
    top = np.full(dimensions, (1 << bits) - 1)
    assert int(morton.encode(top)) == (1 << bits * dimensions) - 1
    assert morton.decode(morton.encode(top), dimensions).tolist() == top.tolist()


@given(
    st.lists(st.integers(0, 2**31 - 1), min_size=2, max_size=2)
    | st.lists(st.integers(0, 2**20 - 1), min_size=3, max_size=3)
)
def test_codes_are_those_of_interleaved_bits(cell):
    code = int(morton.encode(np.array(cell)))
    assert code == slow_code(cell)
    assert morton.decode(np.array(code), len(cell)).tolist() == cell
