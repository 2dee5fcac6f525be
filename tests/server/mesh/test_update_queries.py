"""What goes into a reply to a client that follows the mesh, and which tiles stay."""

import numpy as np
from triquad_map.mesh.tile_lattice import TileBorder
from triquad_server.mesh.tile_cache import tile_lattice
from triquad_server.mesh.tile_level import CachedTile, TileBytes
from triquad_server.mesh.update_queries import TileReply
from triquad_server.settings import MeshSettings


def tile(x: int, *, revision: int, empty: bool = False) -> CachedTile:
    return CachedTile(
        index=(x, 0, 0),
        version=7,
        revision=revision,
        made=7,
        empty=empty,
        digest=b"",
        border=TileBorder(np.zeros((0, 3), np.int16), np.zeros(0, np.float32)),
    )


def test_the_first_tile_always_fits_and_others_up_to_the_limit() -> None:
    reply = TileReply(complete=True, revision=0, max_bytes=100)
    assert reply.fits(bytes(200))
    reply.add(tile(1, revision=3), bytes(99))
    assert reply.fits(bytes(1))
    assert not reply.fits(bytes(2))
    assert reply.fits(b""), "a tile that is to be removed takes no bytes"


def test_a_message_has_the_tiles_and_tells_which_to_remove() -> None:
    reply = TileReply(complete=False, revision=0, max_bytes=100)
    reply.add(tile(1, revision=3), b"abc")
    reply.add(tile(2, revision=4, empty=True), b"")
    reply.add(tile(3, revision=5), b"de")
    lattice = tile_lattice(MeshSettings(), 1)
    message = reply.message(server="here", epoch=9, restart=True, lattice=lattice)
    assert (message.server, message.epoch, message.restart) == ("here", 9, True)
    assert (message.revision, message.complete) == (5, False)
    assert message.tiles.tolist() == [[1, 0, 0], [3, 0, 0]]
    assert message.versions.tolist() == [7, 7]
    assert (message.sizes.tolist(), message.data) == ([3, 2], b"abcde")
    assert message.removed.tolist() == [[2, 0, 0]]
    assert message.cell_m == 0.2


def test_bytes_that_are_unused_for_longest_are_dropped() -> None:
    kept = TileBytes(limit=10)
    kept.put((0, (1, 0, 0)), bytes(4))
    kept.put((0, (2, 0, 0)), bytes(4))
    assert kept.get((0, (1, 0, 0))) == bytes(4)
    kept.put((0, (3, 0, 0)), bytes(4))
    assert kept.get((0, (2, 0, 0))) is None
    assert kept.size == 8
    kept.put((0, (1, 0, 0)), bytes(50))
    assert (kept.get((0, (1, 0, 0))), kept.size) == (bytes(50), 50), "one may be larger"
