"""A server with an empty map, and a client of it; and what a server process is started with.

Modules that need another server have their own.
"""

from collections.abc import Iterator
from pathlib import Path

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


@pytest.fixture
def arguments(tmp_path: Path) -> list[str]:
    """Arguments of a server process of small maps, with a store in ``tmp_path / "store"``."""
    return ["--settings", str(servers.SMALL_FILE), "--store", str(tmp_path / "store")]
