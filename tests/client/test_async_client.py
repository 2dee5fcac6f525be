"""The client for event loops: many calls at a time, cancelled and closed in the midst of them."""

import asyncio
import inspect
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import triquad_client
import zenoh
from support import servers
from support.event_loop import connected
from triquad_client import (
    AsyncClient,
    BadReplyError,
    ClosedError,
    ConnectError,
    InvalidScanError,
    NoReplyError,
    RequestTimeoutError,
    Status,
    UnknownMapError,
)
from triquad_format.errors import RefusedError
from triquad_format.wire import codec, keys
from triquad_format.wire.messages import (
    MapInfo,
    SdfReply,
    SdfRequest,
    ServerStatus,
)
from triquad_map.stored_map import StoredMap

POSE = np.eye(4)
POINTS = servers.sphere(200).astype(np.float64)


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A service that has learnt a sphere."""
    with servers.running_service(store=tmp_path_factory.mktemp("store")) as endpoint:
        with triquad_client.connect(endpoint) as client:
            client.publish_scan(servers.sphere(), POSE)
            client.flush(servers.WAIT_S)
            client.settle(servers.WAIT_S)
        yield endpoint


def sdf_reply(query: zenoh.Query, epoch: int = 3) -> bytes:
    count = len(codec.decode(SdfRequest, query.payload.to_bytes()).points)
    return codec.encode(
        SdfReply(epoch, np.zeros(count, np.float32), np.zeros(count, np.uint8), None)
    )


class Held:
    """Holds queries until it is told to answer them, and counts them."""

    def __init__(self) -> None:
        self.queries: list[zenoh.Query] = []
        self.open = threading.Event()
        self._came = threading.Semaphore(0)

    def __call__(self, query: zenoh.Query, key: str) -> None:
        if self.open.is_set():
            with query:
                query.reply(key, sdf_reply(query))
            return
        self.queries.append(query)
        self._came.release()

    async def came(self, count: int) -> None:
        """Return once so many more queries are here."""
        for _ in range(count):
            assert await asyncio.to_thread(self._came.acquire, timeout=servers.WAIT_S)

    def drop(self) -> None:
        for query in self.queries:
            query.drop()


def test_scans_are_learnt_and_all_questions_answered_as_by_the_other_client(tmp_path: Path) -> None:
    with servers.running_service(store=tmp_path / "store") as endpoint:

        async def use(client: AsyncClient) -> None:
            assert client.map_name == servers.MAP
            for number in range(3):
                await client.publish_scan(servers.sphere(), POSE, 10.0 + number)
            report = await client.flush(servers.WAIT_S)
            assert (report.taken, report.refused, report.lost) == (3, 0, 0)
            assert (await client.settle(servers.WAIT_S)).settled
            with triquad_client.connect(endpoint) as other:
                expected = other.query_sdf(POINTS, gradient=True)
                result = await client.query_sdf(POINTS, gradient=True)
                np.testing.assert_array_equal(result.sdf, expected.sdf)
                np.testing.assert_array_equal(result.status, expected.status)
                np.testing.assert_array_equal(result.gradient, expected.gradient)
                assert result.epoch == expected.epoch
                mesh, expected_mesh = await client.mesh(), other.mesh()
                np.testing.assert_array_equal(mesh.vertices, expected_mesh.vertices)
                np.testing.assert_array_equal(mesh.faces, expected_mesh.faces)
                tiles = await client.tiles()
                np.testing.assert_array_equal(tiles.tiles, other.tiles().tiles)
            tile = await client.mesh_tile(*(int(number) for number in tiles.tiles[0]))
            assert len(tile.faces)
            assert (await client.checkpoint()).epoch == result.epoch
            assert (await client.maps()) == [servers.MAP]
            info = await client.download_map(tmp_path / "map.triquad")
            assert info.epoch == result.epoch
            await client.download_box(tmp_path / "box.triquad", ((-5, -5, -5), (0, 0, 0)))
            epoch = (await client.reset()).epoch
            assert (await client.query_sdf(POINTS)).epoch == epoch
            assert (await client.query_sdf(POINTS)).status.max() == Status.UNKNOWN
            for name in ("map", "box"):
                with StoredMap.open(tmp_path / f"{name}.triquad") as stored:
                    assert stored.manifest.facts.epoch == info.epoch

        connected(endpoint, use)


def others_than_receive() -> int:
    """Threads of this process but those with which the server receives, a few for any number."""
    names = (thread.name for thread in threading.enumerate())
    return sum(not name.startswith("receiver-") for name in names)


def test_hundreds_of_queries_at_a_time_are_answered_without_a_thread_each(endpoint: str) -> None:
    async def use(client: AsyncClient) -> None:
        whole = await client.query_sdf(POINTS)
        threads = others_than_receive()
        most = threads

        async def ask(number: int) -> float:
            nonlocal most
            result = await client.query_sdf(POINTS[number % 200 :][:1])
            most = max(most, others_than_receive())
            return float(result.sdf[0])

        single = await asyncio.gather(*(ask(number) for number in range(600)))
        np.testing.assert_allclose(single, np.tile(whole.sdf, 3), atol=1e-5)
        assert most - threads < 10

    connected(endpoint, use)


def test_a_query_of_many_parts_is_joined_in_order(endpoint: str) -> None:
    points = np.tile(POINTS, (1750, 1))  # 3.5 parts

    async def use(client: AsyncClient) -> None:
        few, many = await asyncio.gather(client.query_sdf(POINTS), client.query_sdf(points))
        np.testing.assert_allclose(many.sdf, np.tile(few.sdf, 1750), atol=1e-5)
        assert not hasattr(many, "gradient")
        assert many.epoch == few.epoch

    connected(endpoint, use)


def test_scans_go_out_in_the_order_of_the_calls(endpoint: str) -> None:
    async def use(client: AsyncClient) -> None:
        scans = [
            client.publish_scan(servers.sphere(100), POSE, 50.0 + number, "ordered")
            for number in range(20)
        ]
        await asyncio.gather(*scans)
        report = await client.flush(servers.WAIT_S)
        assert report.taken + report.lost == 20  # a full queue pushes scans out
        assert report.refused == 0
        with pytest.raises(InvalidScanError, match="in order"):
            await client.publish_scan(servers.sphere(100), POSE, 51.0, "ordered")

    connected(endpoint, use)


def test_a_server_or_a_map_that_is_not_there_is_told(endpoint: str) -> None:
    async def connect(endpoint: str, name: str = servers.MAP) -> None:
        async with triquad_client.connect_async(endpoint, name):
            pass

    with pytest.raises(UnknownMapError, match="available: default"):
        asyncio.run(connect(endpoint, "kitchen"))
    with pytest.raises(ConnectError, match="Start triquad-server"):
        asyncio.run(connect(servers.free_endpoint()))


def test_replies_that_are_none_are_told_apart() -> None:
    held = Held()

    def nonsense(query: zenoh.Query, key: str) -> None:
        with query:
            query.reply(key, b"\xff\x00")

    async def use(client: AsyncClient) -> None:
        with pytest.raises(RequestTimeoutError, match=r"query/sdf within 0\.2 s"):
            await client.query_sdf(POINTS)
        with pytest.raises(BadReplyError, match="status"):
            await client.status()
        with pytest.raises(NoReplyError, match="access control"):
            await client.tiles()

    with servers.answering({keys.SDF: held, keys.STATUS: nonsense}) as endpoint:
        connected(endpoint, use, timeout_s=0.2)
        held.drop()


def test_cancelled_queries_leave_room_for_others() -> None:
    """More are cancelled than may be under way; what was sent goes no further."""
    held = Held()

    async def use(client: AsyncClient) -> None:
        many = [asyncio.ensure_future(client.query_sdf(POINTS)) for _ in range(100)]
        await held.came(32)
        many[50].cancel()  # waits for its turn
        for task in many:
            task.cancel()
        assert all(
            isinstance(done, asyncio.CancelledError)
            for done in await asyncio.gather(*many, return_exceptions=True)
        )
        assert len(held.queries) == 32
        held.open.set()
        results = await asyncio.gather(*(client.query_sdf(POINTS) for _ in range(100)))
        assert all(len(result.sdf) == 200 for result in results)

    with servers.answering({keys.SDF: held}) as endpoint:
        connected(endpoint, use)
        held.drop()


def test_a_big_query_can_be_cancelled_between_its_parts() -> None:
    held = Held()

    def first_then_hold(query: zenoh.Query, key: str) -> None:
        if codec.decode(SdfRequest, query.payload.to_bytes()).epoch == 0:
            with query:
                query.reply(key, sdf_reply(query))
        else:
            held(query, key)

    async def use(client: AsyncClient) -> None:
        big = asyncio.ensure_future(client.query_sdf(np.zeros((1_000_000, 3))))
        await held.came(4)
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(asyncio.shield(big), 0.05)
        big.cancel()
        with pytest.raises(asyncio.CancelledError):
            await big
        assert len(held.queries) == 4
        assert len((await client.query_sdf(POINTS)).sdf) == 200

    with servers.answering({keys.SDF: first_then_hold}) as endpoint:
        connected(endpoint, use)
        held.drop()


def test_a_real_server_goes_on_after_queries_were_cancelled_at_any_moment(endpoint: str) -> None:
    async def use(client: AsyncClient) -> None:
        points = np.tile(POINTS, (1000, 1))
        for turn in range(40):
            task = asyncio.ensure_future(client.query_sdf(points))
            for _ in range(turn):
                await asyncio.sleep(0.001)
            task.cancel()
            await asyncio.wait({task})
        answer = None
        while answer is None:
            try:
                answer = await client.query_sdf(points)
            except RefusedError as error:
                if error.code != "busy":  # as what was cancelled may still wait there
                    raise
                await asyncio.sleep(0.01)
        assert len(answer.sdf) == len(points)

    connected(endpoint, use)


def test_a_cancelled_download_leaves_the_older_file(tmp_path: Path) -> None:
    path = tmp_path / "map.triquad"
    path.write_text("older")
    held = Held()

    def info(query: zenoh.Query, key: str) -> None:
        with query:
            query.reply(key, codec.encode(MapInfo(1, 100, "0" * 64, 60)))

    async def use(client: AsyncClient) -> None:
        download = asyncio.ensure_future(client.download_map(path))
        await held.came(1)
        download.cancel()
        with pytest.raises(asyncio.CancelledError):
            await download
        assert list(tmp_path.iterdir()) == [path]
        assert path.read_text() == "older"

    with servers.answering({keys.MAP_INFO: info, keys.MAP_CHUNK: held}) as endpoint:
        connected(endpoint, use)
        held.drop()


def test_what_is_under_way_when_the_client_is_closed_says_so(tmp_path: Path) -> None:
    held, held_files = Held(), Held()

    def unsettled(query: zenoh.Query, key: str) -> None:
        with query:
            query.reply(key, codec.encode(unsettled_status()))

    async def use(client: AsyncClient) -> None:
        calls = [client.query_sdf(POINTS) for _ in range(40)]
        calls += [client.settle()]
        calls += [client.download_map(tmp_path / f"{n}.triquad") for n in range(40)]
        tasks = [asyncio.ensure_future(call) for call in calls]
        await held.came(32)
        await held_files.came(1)
        await client.close()
        outcomes = await asyncio.gather(*tasks, return_exceptions=True)
        assert [type(outcome) for outcome in outcomes] == [ClosedError] * 81
        assert not list(tmp_path.iterdir())
        await client.close()
        for call in (client.status(), client.maps(), client.publish_scan(POINTS, POSE)):
            with pytest.raises(ClosedError):
                await call

    answers = {keys.SDF: held, keys.MAP_INFO: held_files, keys.STATUS: unsettled}
    with servers.answering(answers) as endpoint:
        connected(endpoint, use)
        held.drop()
        held_files.drop()


def unsettled_status() -> ServerStatus:
    none: dict[str, int] = {}
    numbers = [0, 0, 0.0, 0, 0, 0, 0, 0.0]
    return ServerStatus(
        servers.MAP, "x", "0", "cpu", 1, False, 0, none, none, 0, none, none, *numbers, None, None
    )


def test_a_connection_that_is_cancelled_while_it_opens_is_closed() -> None:
    endpoint = servers.free_endpoint()

    async def main(router: zenoh.Session) -> None:
        async def connect() -> AsyncClient:
            return await triquad_client.connect_async(endpoint)

        connecting = asyncio.ensure_future(connect())
        while not router.info.transports():
            await asyncio.sleep(0)
        connecting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await connecting
        while router.info.transports():
            await asyncio.sleep(0.01)

    with servers.raw_session("router", listen=endpoint) as router:
        token = router.liveliness().declare_token(keys.alive_key(servers.MAP, "x"))
        asyncio.run(asyncio.wait_for(main(router), servers.WAIT_S))
        token.undeclare()


FORGETFUL = """
import asyncio, sys
import numpy as np, triquad_client

async def main(endpoint, forgotten):
    client = await triquad_client.connect_async(endpoint)
    await client.publish_scan(np.ones((100, 3)) * 3, np.eye(4))
    print((await client.query_sdf(np.zeros((7, 3)))).sdf.shape)
    if forgotten == "query":
        asyncio.ensure_future(client.query_sdf(np.zeros((1_000_000, 3))))
        await asyncio.sleep(0.01)
    if forgotten == "flush":
        asyncio.ensure_future(client.settle())
        await asyncio.sleep(0.01)
    if forgotten == "error":
        raise SystemExit(3)

asyncio.run(main(*sys.argv[1:]))
"""


@pytest.mark.parametrize("forgotten", ["nothing else", "query", "flush", "error"])
def test_a_program_that_forgets_to_close_its_client_ends(endpoint: str, forgotten: str) -> None:
    command = [sys.executable, "-c", FORGETFUL, endpoint, forgotten]
    done = subprocess.run(command, capture_output=True, text=True, timeout=servers.WAIT_S)
    assert done.stdout == "(7,)\n", done.stderr
    assert done.returncode == (3 if forgotten == "error" else 0), done.stderr
    assert "Traceback" not in done.stderr


def test_two_event_loops_have_a_client_each(endpoint: str) -> None:
    meeting = threading.Barrier(2)
    epochs = []

    async def use(client: AsyncClient) -> None:
        await asyncio.to_thread(meeting.wait, servers.WAIT_S)
        results = await asyncio.gather(*(client.query_sdf(POINTS) for _ in range(100)))
        epochs.extend(result.epoch for result in results)

    threads = [threading.Thread(target=connected, args=(endpoint, use)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(epochs) == 200


def test_other_tasks_run_while_a_program_waits() -> None:
    """The reply is sent by a task of the same loop."""
    held = Held()

    async def use(client: AsyncClient) -> None:
        query = asyncio.ensure_future(client.query_sdf(POINTS))
        await held.came(1)
        (waiting,) = held.queries
        key = keys.operation_key(servers.MAP, keys.SDF)
        waiting.reply(key, sdf_reply(waiting))
        waiting.drop()
        assert len((await query).sdf) == 200

    with servers.answering({keys.SDF: held}) as endpoint:
        connected(endpoint, use)


@pytest.mark.parametrize(
    ("blocking", "awaited"),
    [
        (triquad_client.Client, AsyncClient),
        (triquad_client.PinnedMap, triquad_client.AsyncPinnedMap),
        (triquad_client.SyncedMap, triquad_client.AsyncSyncedMap),
        (triquad_client.MeshWatch, triquad_client.AsyncMeshWatch),
    ],
)
def test_both_clients_are_asked_alike_and_documented_alike(blocking: type, awaited: type) -> None:
    def methods(kind: type) -> dict[str, tuple[object, ...]]:
        return {
            name: (
                inspect.getdoc(method),
                *((one.name, one.default) for one in inspect.signature(method).parameters.values()),
            )
            for name, method in inspect.getmembers(kind, inspect.isfunction)
            if not name.startswith("_")
        }

    assert methods(awaited) == methods(blocking)
    assert all(documentation for documentation, *_ in methods(awaited).values())
