"""A server with an empty map, and a client of it; modules that need another one have their own."""

from collections.abc import Iterator

import pytest
import triquad_client
from support import servers
from triquad_client import Client


@pytest.fixture
def endpoint() -> Iterator[str]:
    with servers.running_service() as endpoint:
        yield endpoint


@pytest.fixture
def client(endpoint: str) -> Iterator[Client]:
    with triquad_client.connect(endpoint) as client:
        yield client
