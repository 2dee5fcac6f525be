"""A server process with a small map, for those who attack it."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import triquad_client
from support import servers
from triquad_format.wire.metrics_messages import OperationMetrics


@contextmanager
def attacked_server(folder: Path, *arguments: str) -> Iterator[servers.ServerProcess]:
    """A server process, with its store in a folder, that has learnt a sphere."""
    settings = folder / "settings.toml"
    settings.write_text(servers.SMALL_TOML)
    with servers.server_process(
        ["--settings", settings, "--store", folder / "store", *arguments]
    ) as server:
        with triquad_client.connect(server.endpoint) as client:
            servers.learn(client)
        yield server


def operation(client: triquad_client.Client, name: str) -> OperationMetrics:
    """What became of the requests of an operation so far."""
    return client.metrics().operations[name]


def points(count: int = 1000) -> "np.ndarray[tuple[int, int], np.dtype[np.float64]]":
    """Where a planner asks."""
    return np.random.default_rng(3).uniform(-4, 4, (count, 3))
