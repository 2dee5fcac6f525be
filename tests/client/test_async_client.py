"""The client for event loops: many calls at a time, cancelled and closed in the midst of them."""

import asyncio
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import triquad_client
import zenoh
from support import servers
from support.event_loop import connected
from support.server_records import STATUS
from triquad_client import AsyncClient, ClosedError
from triquad_format.mapfile.reader import StoredMap
from triquad_format.wire import codec, keys
from triquad_format.wire.messages import MapInfo, SdfReply

POSE = np.eye(4)
AROUND = ((-9, -9, -9), (9, 9, 9))
POINTS = servers.sphere(200).astype(np.float64)


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A service that has learnt a sphere."""
    with servers.running_service(store=tmp_path_factory.mktemp("store")) as endpoint:
        with triquad_client.connect(endpoint) as client:
            servers.learn_all(client, 1)
        yield endpoint


class Held:
    """Holds queries until it is told to answer them, and counts them."""

    def __init__(self) -> None:
        self.queries: list[zenoh.Query] = []
        self.open = threading.Event()
        self._came = threading.Semaphore(0)

    def __call__(self, query: zenoh.Query, key: str) -> None:
        if self.open.is_set():
            count = len(POINTS)
            reply = SdfReply(3, np.zeros(count, np.float32), np.zeros(count, np.uint8), None)
            with query:
                query.reply(key, codec.encode(reply))
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


def sends(reply: bytes) -> Callable[[zenoh.Query, str], None]:
    """Answers each query with the same bytes."""

    def answer(query: zenoh.Query, key: str) -> None:
        with query:
            query.reply(key, reply)

    return answer


def test_a_map_is_made_and_asked_as_by_the_other_client(tmp_path: Path) -> None:
    with servers.running_service(store=tmp_path / "store") as endpoint:

        async def use(client: AsyncClient) -> None:
            for number in range(3):
                await client.publish_scan(servers.sphere(), POSE, 10.0 + number)
            report = await client.flush(servers.WAIT_S)
            assert (report.taken, report.refused, report.lost) == (3, 0, 0)
            assert (await client.settle(servers.WAIT_S)).settled
            with triquad_client.connect(endpoint) as other:
                expected = other.query_sdf(POINTS, gradient=True)
                result = await client.query_sdf(POINTS, gradient=True)
                np.testing.assert_equal(vars(result), vars(expected))
                np.testing.assert_equal(vars(await client.mesh()), vars(other.mesh()))
            local = await client.sync(AROUND, tmp_path / "copy.triquad")
            assert (await local.query_sdf(POINTS)).epoch == local.epoch == result.epoch
            info = await client.download_map(tmp_path / "map.triquad")
            with StoredMap.open(tmp_path / "map.triquad") as stored:
                assert stored.manifest.facts.epoch == info.epoch == result.epoch
            epoch = (await client.reset()).epoch
            assert (await client.query_sdf(POINTS)).epoch == epoch

        connected(endpoint, use)


def test_hundreds_of_queries_at_a_time_are_answered(endpoint: str) -> None:
    async def use(client: AsyncClient) -> None:
        whole = await client.query_sdf(POINTS)
        asked = (client.query_sdf(POINTS[number % 200 :][:1]) for number in range(600))
        single = [float(result.sdf[0]) for result in await asyncio.gather(*asked)]
        np.testing.assert_allclose(single, np.tile(whole.sdf, 3), atol=1e-5)

    connected(endpoint, use)


def test_cancelled_queries_leave_room_for_others() -> None:
    held = Held()

    async def use(client: AsyncClient) -> None:
        many = [asyncio.ensure_future(client.query_sdf(POINTS)) for _ in range(100)]
        await held.came(32)
        many[50].cancel()  # one that waits for its turn
        for task in many:
            task.cancel()
        outcomes = await asyncio.gather(*many, return_exceptions=True)
        assert {type(outcome) for outcome in outcomes} == {asyncio.CancelledError}
        assert len(held.queries) == 32, "what was not sent yet never is"
        held.open.set()
        results = await asyncio.gather(*(client.query_sdf(POINTS) for _ in range(100)))
        assert all(len(result.sdf) == 200 for result in results)

    with servers.answering({keys.SDF: held}) as endpoint:
        connected(endpoint, use)
        held.drop()


def test_a_cancelled_download_leaves_the_older_file(tmp_path: Path) -> None:
    path = tmp_path / "map.triquad"
    path.write_bytes(b"")
    held, info = Held(), sends(codec.encode(MapInfo(1, 100, "0" * 64, 60)))

    async def use(client: AsyncClient) -> None:
        download = asyncio.ensure_future(client.download_map(path))
        await held.came(1)
        download.cancel()
        with pytest.raises(asyncio.CancelledError):
            await download
        assert list(tmp_path.iterdir()) == [path]
        assert path.read_bytes() == b""

    with servers.answering({keys.MAP_INFO: info, keys.MAP_CHUNK: held}) as endpoint:
        connected(endpoint, use)
        held.drop()


def test_what_is_under_way_when_the_client_is_closed_says_so(tmp_path: Path) -> None:
    held, held_files = Held(), Held()

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

    status = sends(codec.encode(STATUS))
    answers = {keys.SDF: held, keys.MAP_INFO: held_files, keys.STATUS: status}
    with servers.answering(answers) as endpoint:
        connected(endpoint, use)
        held.drop()
        held_files.drop()


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
    if forgotten == "watch":
        watch = client.watch_mesh(((50, 50, 50), (51, 51, 51)))
        await watch.next(0.0)
        asyncio.ensure_future(watch.next())
        await client.status()  # by then it waits at the server
    if forgotten == "error":
        raise SystemExit(3)

if sys.argv[2] == "watch":  # and its task is not even cancelled
    loop = asyncio.new_event_loop()
    loop.run_until_complete(main(*sys.argv[1:]))
else:
    asyncio.run(main(*sys.argv[1:]))
"""


@pytest.mark.parametrize("forgotten", ["query", "watch", "error"])
def test_a_program_that_forgets_to_close_its_client_ends(endpoint: str, forgotten: str) -> None:
    command = [sys.executable, "-c", FORGETFUL, endpoint, forgotten]
    done = subprocess.run(command, capture_output=True, text=True, timeout=servers.WAIT_S)
    assert done.stdout == "(7,)\n", done.stderr
    assert done.returncode == (3 if forgotten == "error" else 0), done.stderr
    assert "Traceback" not in done.stderr
