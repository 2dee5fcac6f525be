"""Has all kernels compiled before the first scan needs them."""

from collections.abc import Callable

import numpy as np
from triquad_map.questions.distance import DistanceOptions, distances

from triquad_server.mapping.mapper import Mapper
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.settings import Settings
from triquad_server.threads import Teams

_DIRECTIONS = 400
_RADIUS_M = 3.0


def warm_up(
    settings: Settings, device: str, report: Callable[[str], None] = lambda _: None
) -> None:
    """Map and ask a made-up sphere, and forget it.

    Compiling takes a minute at the very first start; then the compiled code is found on disk.
    ``report`` is told what comes next.
    """
    count = min(_DIRECTIONS, settings.scan.max_points)
    directions = np.random.default_rng(0).normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radius = min(max(_RADIUS_M, settings.scan.range_min_m), settings.scan.range_max_m)
    teams = Teams()
    mapper = Mapper("warm-up", settings, device, teams=teams)
    report("taking in scans")
    mapper.ingest((directions * radius).astype(np.float32), np.eye(4))
    report("training")
    mapper.train()
    epoch = mapper.publish()
    report("queries")
    epoch.query(directions, gradient=True)
    distances(epoch, directions, DistanceOptions(unknown_distance=True))
    report("meshes")
    cache = TileCache(settings.mesh, teams.meshing)
    cache.refresh(epoch)
    cache.make(0, (0, 0, 0))
