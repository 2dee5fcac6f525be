"""Clients in event loops, for tests that are no coroutines."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeVar

import triquad_client
from support.servers import WAIT_S
from triquad_client import AsyncClient

ResultT = TypeVar("ResultT")


def connected(
    endpoint: str, use: Callable[[AsyncClient], Awaitable[ResultT]], timeout_s: float = 10.0
) -> ResultT:
    """What ``use`` returns of a client in an event loop of its own."""

    async def main() -> ResultT:
        async with triquad_client.connect_async(endpoint, timeout_s=timeout_s) as client:
            return await asyncio.wait_for(use(client), WAIT_S)

    return asyncio.run(main())
