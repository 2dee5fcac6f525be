"""Columns of numbers as bytes, and back."""

import numpy as np
from triquad_format.mapfile.parts.part import (
    LEVEL_BITS,
    shuffle,
    shuffle_codes,
    split_bits,
    split_integers,
    unshuffle,
)
from triquad_format.records.region import MAX_INTEGER


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
