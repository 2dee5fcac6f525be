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
def settings(tmp_path: Path) -> Path:
    """A file with the settings of small maps."""
    path = tmp_path / "server.toml"
    path.write_text(servers.SMALL_TOML)
    return path


@pytest.fixture
def arguments(tmp_path: Path, settings: Path) -> list[str]:
    """Arguments of a server process with these settings, and a store in ``tmp_path / "store"``."""
    return ["--settings", str(settings), "--store", str(tmp_path / "store")]
