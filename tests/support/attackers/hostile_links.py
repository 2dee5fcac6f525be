"""Links to a server that mean it no good."""

import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager


@contextmanager
def half_open(endpoint: str, count: int) -> Iterator[None]:
    """So many connections that never say a word."""
    host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
    with ExitStack() as links:
        for _ in range(count):
            link = links.enter_context(socket.socket())
            link.setblocking(False)
            link.connect_ex((host, int(port)))
        yield
