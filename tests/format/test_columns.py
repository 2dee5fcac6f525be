"""Columns of numbers as bytes, and back."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from triquad_format.mapfile.parts.part import (
    LEVEL_BITS,
    join_bits,
    join_integers,
    shuffle,
    shuffle_codes,
    split_bits,
    split_integers,
    unshuffle,
    unshuffle_codes,
)
from triquad_format.records.region import MAX_INTEGER, MAX_LEVEL


@given(st.lists(st.integers(0, 2**47), unique=True))
def test_codes_round_trip(codes: list[int]) -> None:
    array = np.array(sorted(codes), np.int64)
    np.testing.assert_array_equal(unshuffle_codes(shuffle_codes(array)), array)


@given(st.lists(st.integers(-MAX_INTEGER, MAX_INTEGER), min_size=1))
def test_integers_round_trip(integers: list[int]) -> None:
    array = np.array(integers, np.int16)[:, None]
    np.testing.assert_array_equal(join_integers(split_integers(array)), array)


def test_literal_bytes_of_columns() -> None:
    assert shuffle_codes(np.array([1, 3, 300])).tolist() == [[1, 2, 41], [0, 0, 1]]
    assert shuffle_codes(np.array([], np.int64)).shape == (1, 0)
    halves = np.array([[1.0, -2.0]], "<f2")  # 0x3c00, 0xc000
    assert shuffle(halves).tolist() == [[[0x00, 0x00]], [[0x3C, 0xC0]]]
    np.testing.assert_array_equal(unshuffle(shuffle(halves), "<f2"), halves)
    assert split_integers(np.array([[1, -128], [2, 127]])).tolist() == [[[1, 2], [-128, 127]]]
    wide = np.array([[128, -300, MAX_INTEGER]])
    assert split_integers(wide).tolist() == [[[-128], [-44], [127]], [[1], [-1], [127]]]
    assert split_bits(np.array([0, 3, 4, 6], np.uint8), LEVEL_BITS).tolist() == [
        [0x0C],
        [0x06],
        [0x08],
    ]


@given(st.lists(st.integers(0, MAX_LEVEL)))
def test_levels_round_trip(levels: list[int]) -> None:
    array = np.array(levels, np.uint8)
    np.testing.assert_array_equal(join_bits(split_bits(array, LEVEL_BITS), len(array)), array)
