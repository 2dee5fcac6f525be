"""A short drive whose poses are off, and the map that the true ones make."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np
import triquad_client
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from support.maps.small_world import world
from support.poses import shifted
from triquad_client import Client
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings

Array = NDArray[np.float64]

SCANS = 6
SETTINGS = Settings.model_validate(
    {"field": {"leaf_m": 0.2}, "store": {"log_max_bytes": 10**9, "period_s": 0}}
)
SAME = 0.995  # share of voxels that are within one of each other


def off(share: float = 1.0) -> Array:
    """How far a pose is off, in the sensor's own frame."""
    pose, angle = shifted(y=0.7 * share), np.radians(3.0 * share)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return pose


@cache
def truth(scans: int = SCANS) -> Array:
    """The surface voxels [N, 3] of the drive with its true poses."""
    mapper = Mapper("truth", SETTINGS, "cpu")
    for scan in world(SCANS).scans[:scans]:
        mapper.ingest(scan.points, scan.world_from_sensor, no_return=scan.no_return)
    with triquad_client.OfflineMap(mapper.publish().record()) as done:
        return done.surface_voxels()


def surface(client: Client, folder: Path) -> Array:
    client.download_map(folder / "now.triquad")
    with triquad_client.open_map(folder / "now.triquad") as found:
        return found.surface_voxels()


def shared(found: Array, expected: Array) -> float:
    """The share of voxels that are within one of the others, the lesser of both ways."""
    ways = [(found, expected), (expected, found)]
    return min(float((cKDTree(there).query(here)[0] < 0.21).mean()) for here, there in ways)


@contextmanager
def once_it_begins(action: Callable[[], object]) -> Iterator[None]:
    """Do something once the map of a server in this process begins to be made again."""
    logger, begins = logging.getLogger("triquad_server"), _Begins(action)
    logger.addHandler(begins)
    try:
        yield
    finally:
        logger.removeHandler(begins)
    assert begins.is_done


class _Begins(logging.Handler):
    def __init__(self, action: Callable[[], object]) -> None:
        super().__init__(logging.INFO)
        self._action = action
        self.is_done = False

    def emit(self, record: logging.LogRecord) -> None:
        if not self.is_done and "regions are made again" in record.getMessage():
            self.is_done = True
            self._action()
