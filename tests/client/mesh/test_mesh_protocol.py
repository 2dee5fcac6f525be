"""Followers of the mesh that speak the wire protocol by hand."""

from collections.abc import Iterator

import numpy as np
import pytest
import triquad_client
from support import servers
from support.requests import tile_updates
from support.watched_ball import SETTINGS, learn
from triquad_client import Client
from triquad_format.wire import codec, keys
from triquad_format.wire.mesh_messages import (
    TileUpdates,
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


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"minimum": np.full(3, np.nan)}, "bad_request"),
        ({"level": 7}, "bad_request"),
        ({"revision": 10**12}, "bad_request"),
        ({"max_bytes": 0}, "bad_request"),
        ({"known_versions": np.ones(3, np.int64)}, "bad_request"),
        (
            {
                "known": np.zeros((100_001, 3), np.int32),
                "known_versions": np.zeros(100_001, np.int64),
            },
            "too_large",
        ),
    ],
)
def test_bad_requests_are_refused(endpoint: str, changes: dict[str, object], code: str) -> None:
    with servers.raw_session(connect=endpoint) as session:
        peer = servers.RawPeer(session)
        assert peer.refusal(keys.TILE_UPDATES, tile_updates(**changes)) == code
        assert isinstance(peer.ask(keys.TILE_UPDATES, codec.encode(tile_updates())), bytes)


def tiles_by_hand(peer: servers.RawPeer, **changes: object) -> TileUpdates:
    answer = peer.ask(keys.TILE_UPDATES, codec.encode(tile_updates(**changes)))
    assert not isinstance(answer, ErrorReply)
    assert answer is not None
    return codec.decode(TileUpdates, answer)


def test_the_protocol_by_hand(client: Client, endpoint: str) -> None:
    """As the document says: a cursor, small replies, tiles decoded by its words."""
    learn(client)
    with servers.raw_session(connect=endpoint) as session:
        peer = servers.RawPeer(session)
        known: dict[tuple[int, int, int], bytes] = {}
        versions: dict[tuple[int, int, int], int] = {}
        reply = tiles_by_hand(peer, max_bytes=1)
        while not reply.complete:
            assert len(reply.tiles) <= 1, "more than max_bytes only where a tile is larger"
            for (x, y, z), version in zip(
                reply.tiles.tolist(), reply.versions.tolist(), strict=True
            ):
                known[x, y, z], versions[x, y, z] = reply.data, version
            reply = tiles_by_hand(
                peer,
                max_bytes=1,
                server=reply.server,
                revision=reply.revision,
                known=np.array(list(versions), np.int32).reshape(-1, 3),
                known_versions=np.array(list(versions.values()), np.int64),
            )
        for x, y, z in reply.tiles.tolist():
            known[x, y, z] = reply.data
        with client.watch_mesh() as watch:
            watch.catch_up()
            assert watch.tiles.keys() == known.keys()
            for index, data in known.items():
                surface = decode_tile(data)
                tile = watch.tiles[index]
                np.testing.assert_array_equal(surface.positions(0.1), tile.vertices)
                np.testing.assert_array_equal(surface.faces, tile.faces)
        later = tiles_by_hand(peer, server=reply.server, revision=reply.revision)
        assert (later.complete, len(later.tiles), later.restart) == (True, 0, False)
        strange = tiles_by_hand(peer, server="another", revision=10**6)
        assert strange.restart
        assert strange.server == reply.server
