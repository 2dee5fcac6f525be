"""Followers of the mesh that speak the wire protocol by hand."""

import time
from collections.abc import Iterator

import numpy as np
import pytest
import triquad_client
from support import servers
from support.watched_ball import SETTINGS, learn
from triquad_client import Client
from triquad_format.wire import codec, keys
from triquad_format.wire.mesh_messages import (
    MeshReply,
    MeshRequest,
    TileChanges,
    TileChangesRequest,
)
from triquad_format.wire.messages import ErrorReply
from triquad_format.wire.tile_codec import decode_tile


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with servers.running_service(SETTINGS) as endpoint:
        yield endpoint


@pytest.fixture(scope="module")
def client(endpoint: str) -> Iterator[Client]:
    with triquad_client.connect(endpoint) as client:
        yield client


def by_hand(peer: servers.RawPeer, request: TileChangesRequest) -> TileChanges:
    answer = peer.ask(keys.TILE_CHANGES, codec.encode(request))
    assert not isinstance(answer, ErrorReply)
    assert answer is not None
    return codec.decode(TileChanges, answer)


def test_the_protocol_by_hand(client: Client, endpoint: str) -> None:
    """As the document says: what changed, then these tiles, decoded by its words."""
    learn(client)
    with servers.raw_session(connect=endpoint) as session:
        peer = servers.RawPeer(session)
        known: dict[tuple[int, int, int], bytes] = {}
        while not (told := by_hand(peer, servers.tile_changes())).is_newest:
            time.sleep(0.1)
        for (x, y, z), changed in zip(told.tiles.tolist(), told.changed.tolist(), strict=True):
            request = MeshRequest(np.array([[x, y, z]], np.int32), 0)
            answer = peer.ask(keys.MESH, codec.encode(request))
            assert isinstance(answer, bytes)
            reply = codec.decode(MeshReply, answer)
            assert reply.versions[0] >= changed
            known[x, y, z] = reply.data
        with client.watch_mesh() as watch:
            watch.catch_up()
            surfaces = {index: decode_tile(data) for index, data in known.items()}
            assert watch.tiles.keys() == {i for i, s in surfaces.items() if len(s.faces)}
            for index, tile in watch.tiles.items():
                np.testing.assert_array_equal(surfaces[index].positions(0.1), tile.vertices)
                np.testing.assert_array_equal(surfaces[index].faces, tile.faces)
        later = by_hand(peer, servers.tile_changes(server=told.server, since=told.revision))
        assert (later.is_newest, len(later.tiles)) == (True, 0)
        strange = by_hand(peer, servers.tile_changes(server="another", since=10**6))
        assert strange.server == told.server
        assert {tuple(tile) for tile in strange.tiles.tolist()} == watch.tiles.keys()
