"""Requests as others make them."""

from dataclasses import replace

import numpy as np
from triquad_format.wire.mesh_messages import TileChangesRequest


def tile_changes(**changes: object) -> TileChangesRequest:
    """A good request for all of a map's mesh, but for ``changes``."""
    everywhere = np.full(3, -np.inf), np.full(3, np.inf)
    good = TileChangesRequest(*everywhere, level=0, server="", since=0)
    return replace(good, **changes)  # type: ignore[arg-type]
