"""Followers of the mesh, over the loopback: only what changed travels, and all hold the same."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import triquad_client
import zenoh
from support import servers
from support.requests import tile_updates
from triquad_client import Client, InvalidInputError, MeshWatch, RequestTimeoutError
from triquad_format.wire import codec, keys
from triquad_format.wire.mesh_messages import (
    TileUpdates,
)
from triquad_format.wire.messages import ErrorReply
from triquad_format.wire.tile_codec import decode_tile
from triquad_server.settings import MeshSettings, ServiceSettings

POSE = np.eye(4)
SETTINGS = servers.SMALL.model_copy(update={"mesh": MeshSettings(tile_cells=16, tolerance_m=0.1)})


def digests(watch: MeshWatch) -> dict[tuple[int, int, int], str]:
    return {index: tile.digest for index, tile in watch.tiles.items()}


def learn(client: Client, points: np.ndarray | None = None) -> None:
    for _ in range(3):
        client.publish_scan(servers.sphere() if points is None else points, POSE)
    client.flush(servers.WAIT_S)
    client.settle(servers.WAIT_S)


def half(side: int) -> np.ndarray:
    """The half of the ball at x > 0, or at x < 0."""
    points = servers.sphere(12_000)
    return points[np.sign(points[:, 0]) == side]


@pytest.fixture
def endpoint() -> Iterator[str]:
    with servers.running_service(SETTINGS) as endpoint:
        yield endpoint


@pytest.fixture
def client(endpoint: str) -> Iterator[Client]:
    with triquad_client.connect(endpoint) as client:
        yield client


def test_a_watch_holds_the_mesh_and_follows_it(client: Client) -> None:
    learn(client, half(1))
    with client.watch_mesh() as watch:
        watch.catch_up()
        assert watch.complete
        first = watch.mesh()
        assert np.abs(np.linalg.norm(first.vertices, axis=1) - servers.RADIUS_M).mean() < 0.2
        assert first.vertices[:, 0].min() > -1
        learn(client, half(-1))
        changed = set()
        while not (update := watch.next(servers.WAIT_S)).complete:
            changed.update(update.changed)
        watch.catch_up()
        assert changed | set(update.changed)
        assert watch.mesh().vertices[:, 0].min() < -3
        assert watch.mesh().epoch == client.status().epoch
    assert watch.next(servers.WAIT_S) is None, "closed"


def test_late_joiners_hold_the_same_bytes(client: Client, endpoint: str) -> None:
    learn(client, half(1))
    with client.watch_mesh() as early, client.watch_mesh(max_bytes_per_s=200_000) as slow:
        early.catch_up()
        for _ in range(2):
            learn(client, half(-1))
            early.catch_up()
        slow.catch_up(servers.WAIT_S)
        with triquad_client.connect(endpoint) as other, other.watch_mesh() as late:
            late.catch_up()
            assert len(early.tiles) > 50
            assert digests(late) == digests(early) == digests(slow)
            assert {i: t.version for i, t in late.tiles.items()} == {
                i: t.version for i, t in early.tiles.items()
            }
            assert len(set(tile.version for tile in early.tiles.values())) > 1


def test_of_known_tiles_only_the_difference_travels(client: Client) -> None:
    learn(client)
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


def test_levels_are_the_same_surface_with_fewer_faces(client: Client) -> None:
    learn(client)
    faces = []
    for level in range(3):
        with client.watch_mesh(level=level) as watch:
            watch.catch_up()
            mesh = watch.mesh()
            faces.append(len(mesh.faces))
            error = np.abs(np.linalg.norm(mesh.vertices, axis=1) - servers.RADIUS_M)
            assert error.mean() < 0.2
            assert watch.level == level
    assert faces[0] > 2 * faces[1] > 4 * faces[2] > 0


def test_a_watch_of_a_box_has_the_tiles_that_meet_it(client: Client) -> None:
    learn(client)
    bounds = ((0.2, 0.2, -9), (9, 9, 9))
    with client.watch_mesh(bounds) as watch:
        watch.catch_up()
        assert watch.tiles
        assert all(x >= 0 and y >= 0 for x, y, _ in watch.tiles)
        mesh = watch.mesh()
        assert (mesh.vertices[mesh.faces].mean(axis=1)[:, :2] >= 0.2).all()


def test_a_cap_makes_replies_small(client: Client) -> None:
    learn(client)
    with client.watch_mesh() as free, client.watch_mesh(max_bytes_per_s=20_000) as capped:
        free.catch_up()
        largest = max(tile.size_bytes for tile in free.tiles.values())
        sizes = []
        while not capped.complete:
            update = capped.next(servers.WAIT_S)
            sizes.append(update.size_bytes)
        assert len(sizes) > 1
        assert max(sizes) <= max(20_000, largest)
        assert digests(capped) == digests(free)


def test_a_watch_that_waits_ends_when_something_comes(client: Client, endpoint: str) -> None:
    """Many wait at once, and none of them holds up queries or the others."""
    learn(client, half(1))
    watches = [client.watch_mesh() for _ in range(12)]
    for watch in watches:
        watch.catch_up()
    with ThreadPoolExecutor(len(watches)) as threads:
        waiting = [threads.submit(watch.next, servers.WAIT_S) for watch in watches]
        with triquad_client.connect(endpoint) as other:
            assert len(other.query_sdf(servers.sphere(50)).sdf) == 50
            other.tiles()
            assert other.status().map_name == servers.MAP
            learn(other, half(-1))
        assert all(future.result().changed for future in waiting)
    for watch in watches:
        watch.catch_up()
    assert all(digests(watch) == digests(watches[0]) for watch in watches)


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"minimum": np.full(3, np.nan)}, "bad_request"),
        ({"level": 7}, "bad_request"),
        ({"revision": 10**12}, "bad_request"),
        ({"max_bytes": 0}, "bad_request"),
        ({"timeout_s": np.inf}, "bad_request"),
        ({"client": "a/b"}, "bad_request"),
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
    client: Client, arguments: dict[str, object]
) -> None:
    with pytest.raises(InvalidInputError):
        client.watch_mesh(**arguments)  # type: ignore[arg-type]


def held_by(session: zenoh.Session) -> "zenoh.handlers.FifoChannel":
    """A request that waits at the server once this returns."""
    key = keys.operation_key(servers.MAP, keys.TILE_UPDATES)
    payload = codec.encode(tile_updates(timeout_s=50.0))
    answers = session.get(key, payload=payload, timeout=servers.WAIT_S)
    assert servers.RawPeer(session).refusal(keys.FLUSH, b"") == "bad_request"  # it went later
    return answers


def test_too_many_followers_are_told_to_come_back() -> None:
    few = SETTINGS.model_copy(update={"service": ServiceSettings(request_queue=2)})
    with servers.running_service(few) as endpoint, servers.raw_session(connect=endpoint) as session:
        held = [held_by(session) for _ in range(2)]
        assert servers.RawPeer(session).refusal(keys.TILE_UPDATES, tile_updates()) == "busy"
        assert len(held) == 2


def test_a_server_that_stops_says_so() -> None:
    service = servers.running_service(SETTINGS)
    with servers.raw_session(connect=service.__enter__()) as session:
        answers = held_by(session)
        service.__exit__(None, None, None)
        (reply,) = answers
        code = codec.decode(ErrorReply, reply.err.payload.to_bytes()).code
        assert code in ("timeout", "busy")  # held by then, or about to be


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


def test_a_restarted_server_is_followed_anew(tmp_path: Path) -> None:
    """What is held from the old process is void: all comes again, and the old stays until then."""
    settings = tmp_path / "settings.toml"
    settings.write_text(servers.SMALL_TOML + "[mesh]\ntile_cells = 16\n")
    arguments = ["--store", tmp_path / "store", "--settings", settings]
    with servers.server_process(arguments) as server:
        with triquad_client.connect(server.endpoint) as client, client.watch_mesh() as watch:
            learn(client)
            watch.catch_up()
            known = watch.known_tiles()
            client.checkpoint()
        server.process.send_signal(signal.SIGTERM)
        assert server.wait() == 0
    assert len(known.tiles) > 50
    with (
        servers.server_process(arguments) as server,
        triquad_client.connect(server.endpoint) as client,
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


FROZEN = """
import sys
import numpy as np, triquad_client
from triquad_client.net.answering import Ask
from triquad_format.wire import keys
from triquad_format.wire import codec
from triquad_format.wire.mesh_messages import TileUpdatesRequest, TileUpdates
everywhere = np.full(3, np.inf)
with triquad_client.connect(sys.argv[1]) as client:
    asks = TileUpdatesRequest(-everywhere, everywhere, 0, "", 0, np.zeros((0, 3), np.int32),
        np.zeros(0, np.int64), 100_000_000, 60.0, "frozen", 0)
    ask = Ask(keys.TILE_UPDATES, asks, TileUpdates, background=True)
    pending = [client._connection._send(ask) for _ in range(24)]
    print(len(client._connection._read(ask, next(iter(pending[0]))).data), flush=True)
    for replies in pending[1:]:
        list(replies)
"""


def test_a_frozen_client_holds_up_nobody(tmp_path: Path) -> None:
    """Stopped amid large replies, it delays no query and no tile of others for good."""
    settings = tmp_path / "settings.toml"
    settings.write_text(servers.SMALL_TOML + "[mesh]\ncell_m = 0.025\n")
    with (
        servers.server_process(["--settings", settings]) as server,
        triquad_client.connect(server.endpoint) as client,
        client.watch_mesh() as watch,
    ):
        learn(client, half(1))
        watch.catch_up()
        size = sum(tile.size_bytes for tile in watch.tiles.values())
        assert size > 500_000
        command = [sys.executable, "-c", FROZEN, server.endpoint]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as frozen:
            try:
                assert frozen.stdout is not None
                assert int(frozen.stdout.readline()) > 100_000
                os.kill(frozen.pid, signal.SIGSTOP)
                for _ in range(20):  # while Zenoh gives up the frozen one, and after
                    with client.watch_mesh() as late:
                        late.catch_up(servers.WAIT_S)
                        assert digests(late) == digests(watch)
                for _ in range(200):
                    assert len(client.query_sdf(servers.sphere(500)).sdf) == 500
                learn(client, half(-1))
                before = digests(watch)
                watch.catch_up(servers.WAIT_S)
                assert digests(watch) != before
                with client.watch_mesh() as late:
                    late.catch_up(servers.WAIT_S)
                    assert digests(late) == digests(watch)
                stat = Path(f"/proc/{frozen.pid}/stat")
                if stat.exists():
                    assert stat.read_text().rpartition(")")[2].split()[0] == "T"
            finally:
                frozen.kill()


def test_iteration_ends_with_the_watch(client: Client) -> None:
    learn(client)
    watch = client.watch_mesh()
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


def test_a_server_that_does_not_answer_is_an_error_and_the_tiles_stay(client: Client) -> None:
    with client.watch_mesh() as watch:
        watch.catch_up(servers.WAIT_S)
        known = watch.known_tiles()
    silent: list[zenoh.Query] = []
    answers = {keys.TILE_UPDATES: lambda query, key: silent.append(query)}
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
