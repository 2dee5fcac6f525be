"""Functions that give a program a client: connected to a server, at once or awaited."""

import asyncio
from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from triquad_client.async_client import AsyncClient
from triquad_client.client import Client
from triquad_client.net.async_driver import AsyncDriver
from triquad_client.net.connection import Connection, open_connection

MAX_DOWNLOAD_BYTES = 2**30
"""Some hundred times the map of a town; larger ones need a limit of the caller's."""


def connect(
    endpoint: str | None = None,
    map: str = "default",  # noqa: A002 - the word of the command line and of the documentation
    *,
    timeout_s: float = 10.0,
    config: str | Path | None = None,
    max_download_bytes: int = MAX_DOWNLOAD_BYTES,
) -> Client:
    """Connect to a map server.

    Args:
        endpoint: of the server, or of a router that leads to it: a host such as ``robot`` or
            ``robot:7447``, or an endpoint of Zenoh; ``None``: where ``config`` says, and otherwise
            port 7447 of this machine.
        map: name of the map.
        timeout_s: for connecting and for each request.
        config: Zenoh configuration file (JSON5), such as one of triquad-keys with credentials.
        max_download_bytes: the largest map file that is fetched from the server, and the most that
            the mesh of a box may take of memory, whatever the server announces.

    Raises:
        ConnectError: nothing listens at the endpoint, or it does not let us in.
        UnknownMapError: no server there has this map.
        InvalidInputError: there cannot be an endpoint or a map of this name.
    """
    return Client(
        open_connection(endpoint, map, timeout_s, config, max_download_bytes=max_download_bytes)
    )


class Connecting:
    """A client that is being connected: await it, or use it in an ``async with`` statement."""

    def __init__(self, open_: Callable[[], Connection]) -> None:
        """Use :func:`connect_async`."""
        self._open = open_

    def __await__(self) -> Generator[Any, None, AsyncClient]:
        return self._connect().__await__()

    async def __aenter__(self) -> AsyncClient:
        self._client = await self
        return self._client

    async def __aexit__(self, *_: object) -> None:
        await self._client.close()

    async def _connect(self) -> AsyncClient:
        sender = ThreadPoolExecutor(1, "triquad-sender")
        opening = sender.submit(self._open)
        try:
            connection = await asyncio.wrap_future(opening)
        except BaseException:
            opening.add_done_callback(_close_late)
            sender.shutdown(wait=False)
            raise
        return AsyncClient(connection, AsyncDriver(connection, sender))


def connect_async(
    endpoint: str | None = None,
    map: str = "default",  # noqa: A002 - the word of the command line and of the documentation
    *,
    timeout_s: float = 10.0,
    config: str | Path | None = None,
    max_download_bytes: int = MAX_DOWNLOAD_BYTES,
) -> Connecting:
    """Connect to a map server: ``async with connect_async(...) as client``, or await it and close.

    Arguments and errors are those of :func:`connect`.
    """
    return Connecting(
        lambda: open_connection(
            endpoint, map, timeout_s, config, max_download_bytes=max_download_bytes
        )
    )


def _close_late(opening: "Future[Connection]") -> None:
    """Close what was opened although its task was cancelled meanwhile."""
    if not opening.cancelled() and opening.exception() is None:
        opening.result().close()
