"""The drive along which most parts are measured."""

from collections.abc import Sequence
from functools import lru_cache

from triquad_server.epochs.epoch import Epoch
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings
from triquad_tools.console.progress import progress
from triquad_tools.sensors.sweep import PosedScan
from triquad_tools.simulation.lidar import Lidar
from triquad_tools.simulation.street import street_drive

from bench.street_scores import DrivenStreet, StreetProbes, driven_street, score_street

SCANS = 100
LENGTH_M = 110.0  # so that the map has some 2 million parameters
_COLUMNS = 1024  # some 60,000 points a scan
_STEPS = 14  # of training between two scans that a map streams in
_PUBLISHED = 5  # one such scan in N


@lru_cache(1)
def bench_street(seed: int) -> DrivenStreet:
    """Return 100 scans along the exact street ``seed``."""
    lidar = Lidar(columns=_COLUMNS)
    return driven_street(street_drive(seed, SCANS, LENGTH_M / SCANS, LENGTH_M, lidar))


def settled_mapper(
    name: str, scans: Sequence[PosedScan], settings: Settings | None = None
) -> Mapper:
    """Return a mapper that has learnt all it can of some scans; ``name`` is shown meanwhile."""
    settings = settings or Settings()
    mapper = Mapper("bench", settings, "cpu")
    with progress(f"mapping {name}", len(scans) + 1) as report:
        for number, scan in enumerate(scans):
            mapper.ingest(scan.points, scan.world_from_sensor)
            report(number, f"scan {number}")
        learn_all(mapper)
        report(len(scans) + 1, "settled")
    return mapper


def learn_all(mapper: Mapper) -> None:
    """Train until nothing is left to learn."""
    while not mapper.settled:
        mapper.train()


def sdf_error_cm(epoch: Epoch, probes: StreetProbes) -> float:
    """Return the mean error of the signed distance at points near the surface."""
    return 100 * score_street(epoch.query, probes).sdf_error_m


class StreamedMap:
    """A map that trains and publishes between scans, as a server's does."""

    def __init__(self, settings: Settings) -> None:
        self.mapper = Mapper("bench", settings, "cpu")
        self._scans = 0

    def take_in(self, scan: PosedScan) -> None:
        """Integrate a scan, and train."""
        self.mapper.ingest(scan.points, scan.world_from_sensor)
        for _ in range(_STEPS):
            self.mapper.train()
        self._scans += 1
        if self._scans % _PUBLISHED == 0:
            self.mapper.publish()
