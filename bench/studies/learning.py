"""``python -m bench.studies.learning``: how soon fields learn.

Each place is mapped in this process: all scans first, then training, scored by samples; then the
robot rests; then it sees the first part of the place again. Places that are not tuned on are only
to be scored.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from triquad_client import Mesh, OfflineMap
from triquad_client.offline.map_mesh import MapTiles, map_lattice
from triquad_client.offline.offline_map import REACH_LEAVES
from triquad_format.records.arrays import Doubles
from triquad_server.epochs.epoch import Epoch
from triquad_server.mapping.mapper import Mapper
from triquad_server.process.resources import resident_bytes
from triquad_server.settings.loading import load_settings
from triquad_tools.console.report import Row, print_rows
from triquad_tools.evaluation.metrics import ScoreSettings
from triquad_tools.sensors.sweep import PosedScan
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive, drive
from triquad_tools.simulation.street import street

from bench.driven import driven
from bench.figures import Figure
from bench.scenes.room import room_by_camera, room_by_lidar
from bench.scenes.tabletop import tabletop_by_camera

_SAMPLES = (100_000, 300_000, 1_000_000, 3_000_000)
_SCORED = 500_000  # samples of a mesh
_RESTING = 60  # scans of a robot at rest
_AGAIN = 8  # one part in this many of the place is seen again
_EPOCH_SAMPLES = 200_000  # samples between two epochs, as on two cores
_STEPS = 12  # of training that there is time for between two scans
_NOISE = 0.1  # of the scans of a robot at rest, as a share of what counts as right


@dataclass(frozen=True)
class Place:
    """A place, a sensor and a way through it."""

    preset: str
    make: Callable[[], SimulatedDrive]
    within_m: float  # nearer than this counts as right
    voxel_m: float  # between the points that are compared
    is_tuned_on: bool = False
    settings: tuple[str, ...] = ()  # over those of the preset


def _street(number: int, lidar: Lidar, scans: int, step_m: float) -> SimulatedDrive:
    scene = street(number, 60.0)
    return SimulatedDrive(scene, lidar, drive(scene, scans, step_m), seed=1)


_PLAIN = Lidar(columns=1024)
_SPARSE = Lidar(beams=16, columns=900, elevation_min_deg=-15, elevation_max_deg=15)
_NOISY = Lidar(beams=32, columns=1024, noise_m=0.05)

PLACES = {
    "street": Place("street", partial(_street, 2, _PLAIN, 50, 1.0), 0.1, 0.05, is_tuned_on=True),
    "room by camera": Place("indoor", partial(room_by_camera, 1, 80), 0.02, 0.01, is_tuned_on=True),
    "street, 16 beams": Place("street", partial(_street, 11, _SPARSE, 30, 1.8), 0.1, 0.05),
    "street, noisy": Place("street", partial(_street, 12, _NOISY, 80, 0.6), 0.1, 0.05),
    "room by lidar": Place("indoor", partial(room_by_lidar, 8, 60), 0.02, 0.01),
    "street, fine": Place(
        "street", partial(_street, 2, _PLAIN, 50, 1.0), 0.02, 0.02, settings=("field.leaf_m=0.05",)
    ),
    "tabletop": Place("tabletop", partial(tabletop_by_camera, 6, 60), 0.01, 0.0025),
}


class _Learner:
    """A map that learns a place, and is scored from time to time."""

    def __init__(self, place: Place) -> None:
        self._place, self._driven = place, driven(place.make(), place.voxel_m)
        self.scans = self._driven.scans
        before = resident_bytes()
        settings = load_settings(None, place.settings, preset=place.preset)
        self.mapper = Mapper("bench", settings, "cpu")
        self._random = np.random.default_rng(0)
        self._samples = 0
        scan_s = statistics.median(map(self._take_in, self.scans))
        self.mapper.publish()
        self.figures = [
            Figure("a scan, processor", 1e3 * scan_s, "ms"),
            Figure("memory with all scans", (resident_bytes() - before) / 1e6, "MB"),
        ]

    def _take_in(self, scan: PosedScan) -> float:
        """Take in a scan; return the processor's seconds."""
        began_s = time.process_time()
        self.mapper.ingest(scan.points, scan.world_from_sensor)
        return time.process_time() - began_s

    def learn(self, samples: float = np.inf) -> None:
        """Train until so many samples were trained on, or nothing is left to learn."""
        published = self.mapper.samples_trained
        while self.mapper.samples_trained < samples and not self.mapper.settled:
            self.mapper.train()
            if self.mapper.samples_trained >= published + _EPOCH_SAMPLES:
                published = self.mapper.samples_trained
                self.mapper.publish()

    def stream(self, scans: Sequence[PosedScan]) -> None:
        """Take in more scans, with time to train between them, then learn all."""
        for scan in scans:
            noise = self._random.normal(0, _NOISE * self._place.within_m, scan.points.shape)
            self.mapper.ingest(scan.points + noise.astype(np.float32), scan.world_from_sensor)
            for _ in range(_STEPS):
                self.mapper.train()
            self.mapper.publish()
        self.learn()

    def score(self, name: str) -> None:
        """Score the mesh of the map as it is."""
        samples = self.mapper.samples_trained - self._samples
        self._samples = self.mapper.samples_trained
        settings = ScoreSettings(
            threshold_m=self._place.within_m, voxel_m=self._place.voxel_m, samples_max=_SCORED
        )
        epoch = self.mapper.publish()
        with OfflineMap(epoch.record()) as opened:
            ends = opened.surface_voxels()
            meshes = {"served": _served(epoch, ends), "in a file": opened.mesh()}
        self.figures.append(Figure(f"{name}: samples", samples / 1e6, "M"))
        for where, mesh in meshes.items():
            scores = self._driven.mesh_scores(mesh, settings)
            self.figures += [
                Figure(f"{name}, {where}: F-score", 100 * scores.f_score, "%"),
                Figure(f"{name}, {where}: accuracy", 100 * scores.accuracy_m, "cm"),
            ]


def _served(epoch: Epoch, ends: Doubles) -> Mesh:
    """Return the mesh of an epoch as a server gives it; rays ended in voxels around ``ends``."""
    voxel_m = epoch.voxel_m
    everywhere = (np.full(3, -np.inf), np.full(3, np.inf))
    lattice = map_lattice(voxel_m / 2, REACH_LEAVES * voxel_m, whole=True)
    return MapTiles(epoch, ends, lattice, everywhere, 0.0, np.zeros(3)).joined(None)


def measure_learning(place: Place) -> list[Figure]:
    """Return figures of a place: by samples, settled, after a rest, and seen again in part."""
    learner = _Learner(place)
    learner.score("0 M")
    for samples in _SAMPLES:
        learner.learn(samples)
        learner.score(f"{samples / 1e6:g} M")
    learner.learn()
    learner.score("settled")
    learner.stream(learner.scans[-1:] * _RESTING)
    learner.score("rested")
    learner.stream(learner.scans[: len(learner.scans) // _AGAIN])
    learner.score("seen again")
    return learner.figures


def main(argv: Sequence[str] | None = None) -> int:
    """Measure places, and print the figures."""
    parser = argparse.ArgumentParser(prog="learning", description=__doc__)
    parser.add_argument("--places", nargs="*", choices=PLACES, default=list(PLACES))
    options = parser.parse_args(argv)
    for place in options.places:
        kind = "tuned on" if PLACES[place].is_tuned_on else "held out"
        figures = measure_learning(PLACES[place])
        print_rows(f"{place} ({kind})", [Row(one.name, one.shown) for one in figures])
    return 0


if __name__ == "__main__":
    sys.exit(main())
