"""Clients that follow the mesh: their requests, while they are pending."""

import math
import time
from dataclasses import dataclass

from triquad_format.wire.messages import TileUpdatesRequest

from triquad_server.mesh.mesher import TileIndex
from triquad_server.net.request import Request
from triquad_server.settings import MeshSettings


@dataclass
class Follower:
    """A pending request for what changed."""

    request: Request
    asks: TileUpdatesRequest
    needs_epoch: int  # the newest epoch when it came
    deadline_s: float  # monotonic
    bytes_per_s: float
    restart: bool  # it knows tiles of another server: they are void
    known_to: int  # it knows everything up to this revision
    held: dict[TileIndex, int]  # versions of tiles that it has whatever the revision
    nothing_at: tuple[int, int] | None = None  # state of the cache that had nothing for it

    @property
    def level(self) -> int:
        """The level of detail that it follows."""
        return self.asks.level


def new_follower(
    request: Request,
    asks: TileUpdatesRequest,
    *,
    server: str,
    epoch: int,
    settings: MeshSettings,
) -> Follower:
    """A request that begins to wait; it has passed its checks.

    ``server`` is the name that replies carry, ``epoch`` the newest.
    """
    restart = asks.server not in ("", server)
    limits = (settings.client_bytes_per_s, asks.max_bytes_per_s)
    return Follower(
        request=request,
        asks=asks,
        needs_epoch=epoch,
        deadline_s=time.monotonic() + min(asks.timeout_s, settings.update_timeout_max_s),
        bytes_per_s=min((limit for limit in limits if limit), default=math.inf),
        restart=restart,
        known_to=0 if restart else asks.revision,
        held={} if restart else _versions(asks),
    )


def _versions(asks: TileUpdatesRequest) -> dict[TileIndex, int]:
    return {
        (x, y, z): version
        for (x, y, z), version in zip(asks.held.tolist(), asks.held_versions.tolist(), strict=True)
    }
