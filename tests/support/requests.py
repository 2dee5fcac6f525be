"""Requests as others make them, and one that waits in a queue without a network."""

import queue
from dataclasses import replace

import numpy as np
from support.servers import WAIT_S
from triquad_format.wire.mesh_messages import TileUpdatesRequest
from triquad_server.fair_queue import Owner


def tile_updates(**changes: object) -> TileUpdatesRequest:
    """A good request for all of a map's mesh, but for ``changes``."""
    good = TileUpdatesRequest(
        minimum=np.full(3, -np.inf),
        maximum=np.full(3, np.inf),
        level=0,
        server="",
        revision=0,
        known=np.zeros((0, 3), np.int32),
        known_versions=np.zeros(0, np.int64),
        max_bytes=1_000_000,
        timeout_s=0.0,
        client="test",
        max_bytes_per_s=0,
    )
    return replace(good, **changes)  # type: ignore[arg-type]


def held_tile_updates(known: int, *, timeout_s: float) -> TileUpdatesRequest:
    """A request for a box where nothing is: it is held until its time is up.

    It names ``known`` tiles that its follower has.
    """
    return tile_updates(
        minimum=np.full(3, 1000.0),
        maximum=np.full(3, 1001.0),
        known=np.arange(3 * known, dtype=np.int32).reshape(-1, 3),
        known_versions=np.ones(known, np.int64),
        timeout_s=timeout_s,
    )


class PendingRequest:
    """Stands for a Zenoh query; keeps its one answer."""

    size = 100

    def __init__(self, asks: object, owner: str = "", defect: Exception | None = None) -> None:
        """It ``asks`` for that; where there is a ``defect``, an answer raises it."""
        self.owner = Owner(owner)
        self._asks = asks
        self._defect = defect
        self._replies: queue.SimpleQueue[object] = queue.SimpleQueue()

    def read(self, _kind: type) -> object:
        return self._asks

    def answer(self, message: object) -> None:
        if self._defect:
            raise self._defect
        self._replies.put(message)

    def refuse(self, code: str, _text: str) -> None:
        self._replies.put(code)

    def fail(self, error: Exception) -> None:
        self.refuse("internal", str(error))

    @property
    def reply(self) -> object:
        """The answer, or the code of a refusal, as soon as there is one."""
        return self._replies.get(timeout=WAIT_S)

    @property
    def waits(self) -> bool:
        """Whether it has no answer yet."""
        return self._replies.empty()
