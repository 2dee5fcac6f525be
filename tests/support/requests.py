"""Requests as others make them."""

from dataclasses import replace

import numpy as np
from triquad_format.wire.mesh_messages import TileUpdatesRequest


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
    )
    return replace(good, **changes)  # type: ignore[arg-type]
