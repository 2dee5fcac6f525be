"""Tiles are answered with again, and only of the newest epoch that was asked for."""

import tracemalloc

import numpy as np
from triquad_format.wire.tile_codec import TileSurface, encode_tile
from triquad_server.mesh.answered_tiles import AnsweredTile, AnsweredTiles, AskedTile


def tile(epoch: int, size: int = 2_000) -> AnsweredTile:
    return AnsweredTile(np.random.default_rng(epoch).bytes(size), None)


def asked(x: int, fill_m: float = 0.0) -> AskedTile:
    return AskedTile(0, (x, 0, -1), fill_m)


def test_a_tile_is_the_same_again() -> None:
    tiles, put = AnsweredTiles(1_000_000), tile(7)
    assert tiles.get(7, asked(1)) is None
    tiles.put(7, asked(1), put)
    assert tiles.get(7, asked(1)) == put
    assert tiles.get(7, asked(2)) is None
    assert tiles.get(7, asked(1, fill_m=0.5)) is None


def test_none_of_another_epoch_is_given() -> None:
    tiles = AnsweredTiles(1_000_000)
    tiles.put(7, asked(1), tile(7))
    assert tiles.get(8, asked(1)) is None
    tiles.put(8, asked(2), tile(8))
    assert tiles.get(7, asked(1)) is None
    alone = tiles.nbytes
    tiles.put(7, asked(1), tile(7))  # of an epoch that a client holds on to
    assert tiles.get(7, asked(1)) is None
    assert tiles.nbytes == alone


def test_what_does_not_fit_is_not_kept_and_pushes_nothing_out() -> None:
    tiles = AnsweredTiles(8_000)
    for x in range(10):
        tiles.put(7, asked(x), tile(7))
    assert 0 < tiles.nbytes <= 8_000
    assert tiles.get(7, asked(0)) is not None
    assert tiles.get(7, asked(9)) is None


def test_marks_of_filled_faces_count() -> None:
    tiles = AnsweredTiles(2_900)
    tiles.put(7, asked(1, fill_m=0.5), tile(7)._replace(filled=np.zeros(1_000, np.uint8)))
    assert tiles.get(7, asked(1, fill_m=0.5)) is None
    tiles.put(7, asked(1, fill_m=0.5), tile(7)._replace(filled=np.zeros(500, np.uint8)))
    assert tiles.nbytes == 2_500


def test_what_is_kept_takes_no_more_memory_than_is_told() -> None:
    rng = np.random.default_rng(3)
    count = 5_000
    lattice = np.sort(rng.integers(0, 64, (count, 3)), axis=0).astype(np.uint16)
    axes, steps = np.zeros(count, np.uint8), rng.integers(0, 256, count).astype(np.uint8)
    faces = np.arange(count - count % 3, dtype=np.int32).reshape(-1, 3)
    surface = TileSurface(lattice, axes, steps, faces=faces)  # which shrinks to a tenth
    tiles, many = AnsweredTiles(10_000_000), 50
    tiles.put(7, asked(-1), AnsweredTile(encode_tile(surface), None))
    tracemalloc.start()
    try:
        for x in range(many):
            tiles.put(7, asked(x), AnsweredTile(encode_tile(surface), None))
        taken, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    told = tiles.nbytes * many / (many + 1)
    assert told < taken < 1.1 * told
