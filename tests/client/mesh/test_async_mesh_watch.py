"""The mesh followed in an event loop: as by the blocking watch, cancelled and closed meanwhile."""

import asyncio
import contextlib
import queue
import threading
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import triquad_client
import zenoh
from support import servers
from support.event_loop import connected
from support.watched_ball import SETTINGS, digests, half
from triquad_client import AsyncClient, ClosedError, KnownTiles
from triquad_format.wire import codec, keys
from triquad_format.wire.mesh_messages import TileChanges


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    """A service that has learnt half of a ball."""
    with servers.running_service(SETTINGS) as endpoint:
        with triquad_client.connect(endpoint) as client:
            servers.learn_all(client, points=half(1))
        yield endpoint


def left(index: int, epoch: int) -> bytes:
    """A reply after which the tile ``(index, 0, 0)`` alone is there."""
    tile, changed = np.array([[index, 0, 0]], np.int32), np.ones(1, np.int64)
    return codec.encode(TileChanges("s", epoch, epoch, True, 1.6, 0.1, tile, changed))


def known_tiles(endpoint: str) -> KnownTiles:
    with triquad_client.connect(endpoint) as client, client.watch_mesh() as watch:
        watch.catch_up(servers.WAIT_S)
        return watch.known_tiles()


def test_an_old_reply_does_not_undo_what_a_later_one_told(endpoint: str) -> None:
    """Two tasks ask at the same time; the reply to the one that asked first comes last."""
    tile = next(iter(known_tiles(endpoint).tiles.values()))
    tiles = {(x, 0, 0): replace(tile, index=(x, 0, 0)) for x in range(2)}
    known = KnownTiles("s", 0, 1.6, tiles)
    first: list[zenoh.Query] = []
    came = threading.Event()

    def answer(query: zenoh.Query, key: str) -> None:
        if not first:
            first.append(query)
            came.set()
            return
        with query:
            query.reply(key, left(0, 2))

    with servers.answering({keys.TILE_CHANGES: answer}) as endpoint:

        async def use(client: AsyncClient) -> None:
            async with client.watch_mesh(known=known) as watch:
                early = asyncio.ensure_future(watch.next(0.0))
                assert await asyncio.to_thread(came.wait, servers.WAIT_S)
                late = await watch.next(0.0)
                assert late is not None
                assert late.removed == ((1, 0, 0),)
                with first[0] as query:
                    key = keys.operation_key(servers.MAP, keys.TILE_CHANGES)
                    query.reply(key, left(1, 1))
                assert await early is None
                assert set(watch.tiles) == {(0, 0, 0)}

        connected(endpoint, use)


def test_any_number_of_watches_wait_at_a_time_until_they_are_closed() -> None:
    count, queries = 100, queue.SimpleQueue[zenoh.Query]()

    async def use(client: AsyncClient) -> None:
        watches = [client.watch_mesh() for _ in range(count)]
        tasks = [asyncio.ensure_future(watch.next()) for watch in watches]
        held = [await asyncio.to_thread(queries.get, timeout=servers.WAIT_S) for _ in tasks]
        for watch in watches:
            await watch.close()
        assert await asyncio.gather(*tasks) == [None] * count
        for query in held:
            query.drop()

    with servers.answering({keys.TILE_CHANGES: lambda query, _: queries.put(query)}) as endpoint:
        connected(endpoint, use, timeout_s=servers.WAIT_S)


def test_a_cancelled_wait_leaves_the_watch_in_order_until_the_client_is_closed(
    endpoint: str,
) -> None:
    async def use(client: AsyncClient) -> None:
        watch, fresh = client.watch_mesh(), client.watch_mesh()
        for steps in range(1, 12):  # cut off in the midst of what comes first
            waiting = asyncio.ensure_future(watch.next())
            for _ in range(steps):
                await asyncio.sleep(0)
            waiting.cancel()
            with contextlib.suppress(asyncio.CancelledError):  # unless the reply was there already
                await waiting
        await watch.catch_up(servers.WAIT_S)
        await fresh.catch_up(servers.WAIT_S)
        assert digests(fresh) == digests(watch)
        waiting = asyncio.ensure_future(watch.next())
        await client.status()  # by then it waits at the server
        await client.close()
        with pytest.raises(ClosedError):
            await waiting
        with pytest.raises(ClosedError):
            await watch.next(0.0)

    connected(endpoint, use)
