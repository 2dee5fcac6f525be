"""Has all kernels compiled before the first scan needs them."""

import numpy as np

from triquad_server.mapper import Mapper
from triquad_server.settings import Settings

_DIRECTIONS = 400
_RADIUS_M = 3.0


def warm_up(settings: Settings, device: str) -> None:
    """Map and ask a made-up sphere, and forget it.

    Compiling takes the better part of a minute at the very first start; then the compiled code is
    found on disk.
    """
    count = min(_DIRECTIONS, settings.scan.max_points)
    directions = np.random.default_rng(0).normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radius = min(max(_RADIUS_M, settings.scan.range_min_m), settings.scan.range_max_m)
    mapper = Mapper("warm-up", settings, device)
    mapper.ingest((directions * radius).astype(np.float32), np.eye(4))
    mapper.train()
    epoch = mapper.publish()
    epoch.query(directions, gradient=True)
    epoch.mesh((0, 0, 0))
