"""Tiles that were answered with are kept for one epoch, as far as they fit."""

import numpy as np
import pytest
from triquad_server.mesh import answered_tiles
from triquad_server.mesh.answered_tiles import AnsweredTile, AnsweredTiles, TileRequest


def tile(text: bytes) -> AnsweredTile:
    return AnsweredTile(text, np.zeros(2, np.uint8))


def test_a_tile_is_that_of_its_epoch_level_place_and_fill() -> None:
    kept, request = AnsweredTiles(), TileRequest(0, (1, 2, 3), 0.5)
    kept.put(7, request, tile(b"seven"))
    assert kept.get(7, TileRequest(0, (1, 2, 3), 0.5)) == kept.get(7, request) is not None
    for other in (TileRequest(1, (1, 2, 3), 0.5), TileRequest(0, (1, 2, 4), 0.5)):
        assert kept.get(7, other) is None
    assert kept.get(7, TileRequest(0, (1, 2, 3), 0.0)) is None
    kept.put(6, request, tile(b"six"))
    assert kept.get(6, request) is None, "only the newest epoch is kept"
    kept.put(8, TileRequest(0, (0, 0, 0), 0.0), tile(b"eight"))
    assert kept.get(7, request) is kept.get(8, request) is None


def test_memory_is_bounded_and_what_came_first_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(answered_tiles, "_MAX_BYTES", 25)
    kept = AnsweredTiles()
    for x in range(5):
        kept.put(1, TileRequest(0, (x, 0, 0), 0.0), tile(b"8 bytes."))
    found = [kept.get(1, TileRequest(0, (x, 0, 0), 0.0)) is not None for x in range(5)]
    assert found == [True, True, False, False, False]
    assert kept.nbytes == 20
