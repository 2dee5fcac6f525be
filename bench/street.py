"""The drive along which most parts are measured."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from triquad_client import Mesh
from triquad_format.records.arrays import Doubles
from triquad_server.epochs.epoch import Epoch
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings
from triquad_tools.console.progress import progress
from triquad_tools.evaluation.metrics import MeshScores, ScoreSettings, score_mesh
from triquad_tools.sensors.sweep import PosedScan
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive, drive
from triquad_tools.simulation.street import street

from bench.figures import seconds
from bench.street_scores import (
    STREET_VOXEL_M,
    DrivenStreet,
    StreetProbes,
    driven_street,
    score_street,
)

SCANS = 100
LENGTH_M = 110.0  # so that the map has some 2 million parameters
_COLUMNS = 1024  # some 60,000 points a scan
_STEPS = 14  # of training between two scans that a map streams in
_PUBLISHED = 5  # one such scan in N


@dataclass(frozen=True)
class BenchStreet(DrivenStreet):
    """A drive of 10 s, and the truth about it."""

    visible: Doubles  # [M, 3] exact surface points that the lidar hit
    samples_max: int = ScoreSettings.samples_max  # of a mesh, to score it

    def mesh_scores(self, mesh: Mesh) -> MeshScores:
        """Return scores of a mesh within the scene's bounds."""
        settings = ScoreSettings(samples_max=self.samples_max)
        return score_mesh(mesh, self.visible, settings, self.drive.scene.sdf)


def bench_street(seed: int) -> BenchStreet:
    """Return 100 scans along the exact street ``seed``."""
    scene = street(seed, LENGTH_M)
    poses = drive(scene, SCANS, LENGTH_M / SCANS)
    driven = driven_street(SimulatedDrive(scene, Lidar(columns=_COLUMNS), poses, seed=seed))
    visible = driven.drive.true_hits(STREET_VOXEL_M)
    low, high = scene.bounds  # to which meshes are cut
    visible = visible[((visible >= low) & (visible <= high)).all(axis=1)]
    return BenchStreet(driven.drive, driven.scans, driven.probes, visible=visible)


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
        self.settings = settings
        self.mapper = Mapper("bench", settings, "cpu")
        self.ingest_s: list[float] = []  # of each scan

    def take_in(self, scan: PosedScan) -> None:
        """Integrate a scan, and train."""
        ingest = partial(self.mapper.ingest, scan.points, scan.world_from_sensor)
        self.ingest_s.append(seconds(ingest))
        for _ in range(_STEPS):
            self.mapper.train()
        if len(self.ingest_s) % _PUBLISHED == 0:
            self.mapper.publish()
