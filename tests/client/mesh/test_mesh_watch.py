"""Followers of the mesh, over the loopback: only what changed travels, and all hold the same."""

import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import triquad_client
import zenoh
from support import servers
from support.watched_ball import SETTINGS, agree, digests, half
from triquad_client import Client, InvalidInputError, RequestTimeoutError
from triquad_format.wire import codec, keys
from triquad_format.wire.mesh_messages import (
    MeshReply,
    MeshRequest,
    TileChanges,
    TileChangesRequest,
)
from triquad_format.wire.tile_codec import decode_tile


@pytest.fixture
def endpoint() -> Iterator[str]:
    with servers.running_service(SETTINGS) as endpoint:
        yield endpoint


@pytest.fixture
def client(endpoint: str) -> Iterator[Client]:
    with triquad_client.connect(endpoint) as client:
        yield client


@pytest.fixture(scope="module")
def learnt() -> Iterator[Client]:
    """A client of a server that has learnt the ball."""
    with servers.service_and_client(SETTINGS) as client:
        servers.learn_all(client)
        yield client


def test_a_watch_holds_the_mesh_and_follows_it(client: Client) -> None:
    servers.learn_all(client, points=half(1))
    with client.watch_mesh() as watch:
        watch.catch_up()
        assert watch.complete
        first = watch.mesh()
        assert np.abs(np.linalg.norm(first.vertices, axis=1) - servers.RADIUS_M).mean() < 0.2
        assert first.vertices[:, 0].min() > -1
        servers.learn_all(client, points=half(-1))
        changed = set()
        while not (update := watch.next(servers.WAIT_S)).complete:
            changed.update(update.changed)
        watch.catch_up()
        assert changed | set(update.changed)
        assert watch.mesh().vertices[:, 0].min() < -3
        assert watch.mesh().epoch == client.status().epoch
    assert watch.next(servers.WAIT_S) is None, "closed"


def test_late_joiners_hold_the_same_bytes(client: Client, endpoint: str) -> None:
    servers.learn_all(client, points=half(1))
    with client.watch_mesh() as early, client.watch_mesh(max_bytes_per_s=200_000) as slow:
        early.catch_up()
        for _ in range(2):
            servers.learn_all(client, points=half(-1))
            early.catch_up()
        client.settle(servers.WAIT_S)  # from then on all are of the same epoch
        with triquad_client.connect(endpoint) as other, other.watch_mesh() as late:
            servers.until(lambda: agree(early, slow, late))
            assert len(early.tiles) > 50
            assert {i: t.version for i, t in late.tiles.items()} == {
                i: t.version for i, t in early.tiles.items()
            }
            assert len(set(tile.version for tile in early.tiles.values())) > 1


def test_of_known_tiles_only_the_difference_travels(client: Client) -> None:
    servers.learn_all(client)
    with client.watch_mesh() as watch:
        watch.catch_up()
        known = watch.known_tiles()
        whole = digests(watch)
    with client.watch_mesh(known=known) as watch:
        assert digests(watch) == whole
        assert watch.next(0.0) is None, "nothing changed"
        assert watch.complete
    lost = min(known.tiles)
    fewer = replace(known, tiles={i: tile for i, tile in known.tiles.items() if i != lost})
    with client.watch_mesh(known=fewer) as watch:
        assert watch.next(servers.WAIT_S).changed == (lost,)
        assert digests(watch) == whole
    client.reset(((1.0, -9, -9), (9, 9, 9)))
    with client.watch_mesh(known=known) as watch:
        watch.catch_up()
        gone = whole.keys() - digests(watch).keys()
        assert {index for index in whole if index[0] >= 1} <= gone


def test_catching_up_sees_what_changed_while_tiles_were_left_to_fetch(client: Client) -> None:
    servers.learn_all(client)
    quarter = ((0.2, 0.2, -9), (9, 9, 9))  # a few more tiles than are fetched at once
    with client.watch_mesh(quarter) as watch:
        assert watch.next(servers.WAIT_S).changed
        assert not watch.complete
        client.reset()
        watch.catch_up()
        assert not watch.tiles


def test_levels_are_the_same_surface_with_fewer_faces(learnt: Client) -> None:
    faces = []
    for level in range(3):
        with learnt.watch_mesh(level=level) as watch:
            watch.catch_up()
            mesh = watch.mesh()
            faces.append(len(mesh.faces))
            error = np.abs(np.linalg.norm(mesh.vertices, axis=1) - servers.RADIUS_M)
            assert error.mean() < 0.2
            assert watch.level == level
    assert faces[0] > 2 * faces[1] > 4 * faces[2] > 0


def test_a_watch_of_a_box_has_the_tiles_that_meet_it(learnt: Client) -> None:
    bounds = ((0.2, 0.2, -9), (9, 9, 9))
    with learnt.watch_mesh(bounds) as watch:
        watch.catch_up()
        assert watch.tiles
        assert all(x >= 0 and y >= 0 for x, y, _ in watch.tiles)
        mesh = watch.mesh()
        assert (mesh.vertices[mesh.faces].mean(axis=1)[:, :2] >= 0.2).all()


def test_a_cap_makes_replies_small_and_rare(learnt: Client) -> None:
    with learnt.watch_mesh() as free, learnt.watch_mesh(max_bytes_per_s=20_000) as capped:
        free.catch_up()
        largest = max(tile.nbytes for tile in free.tiles.values())
        started, sizes = time.monotonic(), []
        while not capped.complete:
            update = capped.next(servers.WAIT_S)
            sizes.append(update.size_bytes)
        assert len(sizes) > 1
        assert sum(sizes[:-1]) <= 20_000 * (time.monotonic() - started)
        assert max(sizes) <= max(20_000, largest)
        assert digests(capped) == digests(free)


def test_who_waits_for_bandwidth_waits_no_longer_than_told(learnt: Client) -> None:
    with learnt.watch_mesh(max_bytes_per_s=1) as watch:
        assert watch.next(servers.WAIT_S).changed
        with pytest.raises(RequestTimeoutError):
            watch.catch_up(0.1)
        assert watch.next(0.1) is None
        assert len(watch.tiles) == 1


def test_a_watch_that_waits_ends_when_something_comes(client: Client, endpoint: str) -> None:
    """Many wait at once, and none of them holds up queries or the others."""
    servers.learn_all(client, points=half(1))
    watches = [client.watch_mesh() for _ in range(12)]
    for watch in watches:
        watch.catch_up()
    with ThreadPoolExecutor(len(watches)) as threads:
        waiting = [threads.submit(watch.next, servers.WAIT_S) for watch in watches]
        with triquad_client.connect(endpoint) as other:
            assert len(other.query_sdf(servers.sphere(50)).sdf) == 50
            other.mesh()
            assert other.status().map_name == servers.MAP
            servers.learn_all(other, points=half(-1))
        assert all(future.result().changed for future in waiting)
    client.settle(servers.WAIT_S)  # from then on all are of the same epoch
    servers.until(lambda: agree(*watches))


@pytest.mark.parametrize(
    "arguments",
    [
        {"level": 3},
        {"level": 1.0},
        {"max_bytes_per_s": 0},
        {"max_bytes_per_s": -5},
        {"bounds": ((np.nan, 0, 0), (1, 1, 1))},
        {"known": triquad_client.KnownTiles("s", 1, 6.4)},
    ],
)
def test_bad_arguments_are_refused_before_anything_is_sent(
    learnt: Client, arguments: dict[str, object]
) -> None:
    with pytest.raises(InvalidInputError):
        learnt.watch_mesh(**arguments)  # type: ignore[arg-type]


def test_a_restarted_server_is_followed_anew(tmp_path: Path) -> None:
    """What is held from the old process is void: all comes again, and the old stays until then."""
    with servers.service_and_client(SETTINGS, store=tmp_path) as client:
        servers.learn_all(client)
        with client.watch_mesh() as watch:
            watch.catch_up()
            known = watch.known_tiles()
    assert len(known.tiles) > 50
    with (
        servers.service_and_client(SETTINGS, store=tmp_path) as client,
        client.watch_mesh(known=known) as watch,
        client.watch_mesh() as fresh,
    ):
        update = watch.next(servers.WAIT_S)
        assert update.changed
        assert known.tiles.keys() <= watch.tiles.keys(), "nothing goes before all is there"
        watch.catch_up()
        fresh.catch_up()
        assert digests(watch) == digests(fresh)
        assert watch.known_tiles().server != known.server


def test_a_server_that_does_not_answer_is_an_error_and_the_tiles_stay(learnt: Client) -> None:
    with learnt.watch_mesh() as watch:
        watch.catch_up()
        known = watch.known_tiles()
    silent: list[zenoh.Query] = []
    answers = {keys.TILE_CHANGES: lambda query, _: silent.append(query)}
    with (
        servers.answering(answers) as endpoint,
        triquad_client.connect(endpoint, timeout_s=0.5) as other,
        other.watch_mesh(known=known) as watch,
    ):
        with pytest.raises(RequestTimeoutError):
            watch.next(0.0)
        assert watch.tiles.keys() == known.tiles.keys()
        for query in silent:
            query.drop()


def test_iteration_ends_with_the_watch(learnt: Client) -> None:
    watch = learnt.watch_mesh()
    seen = threading.Event()

    def follow() -> int:
        count = 0
        for update in watch:
            count += len(update.changed)
            seen.set()
        return count

    with ThreadPoolExecutor(1) as thread:
        following = thread.submit(follow)
        assert seen.wait(servers.WAIT_S)
        watch.close()
        assert following.result(servers.WAIT_S) > 0


def by_hand(peer: servers.RawPeer, request: TileChangesRequest) -> TileChanges:
    answer = peer.ask(keys.TILE_CHANGES, codec.encode(request))
    assert isinstance(answer, bytes)
    return codec.decode(TileChanges, answer)


def test_a_follower_that_speaks_the_protocol_by_hand_holds_the_same(
    client: Client, endpoint: str
) -> None:
    """As the document says: what changed, then these tiles, decoded by its words."""
    servers.learn_all(client)
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
