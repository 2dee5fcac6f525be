"""Tiles are answered with again, and only of the newest epoch that was asked for."""

import tracemalloc
from dataclasses import replace

import numpy as np
from triquad_format.wire.messages import MeshReply
from triquad_server.mesh.answered_tiles import AnsweredTiles


def tile(epoch: int, vertices: int = 100) -> MeshReply:
    rng = np.random.default_rng(epoch)
    return MeshReply(
        epoch=epoch,
        origins=np.array([[6.4, 0.0, -6.4]]),
        counts=np.array([vertices]),
        vertices=rng.uniform(0, 6.4, (vertices, 3)).astype(np.float32),
        faces=rng.integers(0, vertices, (2 * vertices, 3)).astype(np.int32),
    )


def asked(x: int, fill_m: float = 0.0) -> tuple[int, tuple[int, int, int], float]:
    return (0, (x, 0, -1), fill_m)


def test_a_tile_is_the_same_again() -> None:
    tiles, put = AnsweredTiles(1_000_000), tile(7)
    assert tiles.get(7, asked(1)) is None
    tiles.put(7, asked(1), put)
    again = tiles.get(7, asked(1))
    assert again is not None
    np.testing.assert_array_equal(again.vertices, put.vertices)
    np.testing.assert_array_equal(again.faces, put.faces)
    np.testing.assert_array_equal(again.origins, put.origins)
    assert again.filled is None
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


def test_what_is_kept_takes_no_more_memory_than_is_told() -> None:
    def zeros(epoch: int) -> MeshReply:  # which shrink to next to nothing
        return replace(tile(epoch, vertices=5_000), vertices=np.zeros((5_000, 3), np.float32))

    tiles, many = AnsweredTiles(10_000_000), 50
    tiles.put(7, asked(-1), zeros(7))
    tracemalloc.start()
    try:
        for x in range(many):
            tiles.put(7, asked(x), zeros(7))
        taken, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    told = tiles.nbytes * many / (many + 1)
    assert told < taken < 1.1 * told
