"""``python -m bench.studies.learning``: how soon fields learn, and what each rule of learning pays.

Each place is mapped in this process: all scans first, then training, scored by samples; then the
robot rests; then it sees the first part of the place again. Rules can be switched off in turn.
"""

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from unittest.mock import patch

import numpy as np
from triquad_client import OfflineMap
from triquad_format.records.arrays import Doubles, Floats
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.training.focus import Focus
from triquad_server.mapping.training.judgement import Judgement, JudgedPlaces
from triquad_server.mapping.training.slopes import Slopes
from triquad_server.settings.loading import load_settings
from triquad_tools.evaluation.metrics import MeshScores, ScoreSettings, score_against_scene
from triquad_tools.recordings.cloud import merged
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive, drive
from triquad_tools.simulation.street import street

from bench.scenes.room import room_by_camera, room_by_lidar
from bench.scenes.tabletop import tabletop_by_camera

_SAMPLES = (100_000, 300_000, 1_000_000, 3_000_000)
_RESTS = 60  # scans of a robot at rest
_SCORED = 500_000  # samples of a mesh


@dataclass(frozen=True)
class Place:
    """A place, a sensor and a way through it."""

    preset: str
    make: Callable[[int], SimulatedDrive]  # for a seed of the sensor's noise
    within_m: float  # nearer than this counts as right
    voxel_m: float  # between the points that are compared
    is_tuned_on: bool


def _street_by(lidar: Lidar, number: int, scans: int, step_m: float, seed: int) -> SimulatedDrive:
    scene = street(number, 60.0)
    return SimulatedDrive(scene, lidar, drive(scene, scans, step_m), seed)


_SIXTEEN = Lidar(beams=16, columns=900, elevation_min_deg=-15, elevation_max_deg=15)
_NOISY = Lidar(beams=32, columns=1024, noise_m=0.05)

PLACES = {
    "street, 64 beams": Place(
        "street", partial(_street_by, Lidar(columns=1024), 2, 50, 1.0), 0.1, 0.05, True
    ),
    "room, depth camera": Place("indoor", lambda seed: room_by_camera(seed, 80), 0.02, 0.01, True),
    "street, 16 beams, fast": Place(
        "street", partial(_street_by, _SIXTEEN, 11, 30, 1.8), 0.1, 0.05, False
    ),
    "street, 32 beams, 5 cm noise": Place(
        "street", partial(_street_by, _NOISY, 12, 80, 0.6), 0.1, 0.05, False
    ),
    "room, 64 beams": Place("indoor", lambda seed: room_by_lidar(7 + seed, 60), 0.02, 0.01, False),
    "tabletop, depth camera": Place(
        "tabletop", lambda seed: tabletop_by_camera(5 + seed, 60), 0.01, 0.0025, False
    ),
}


def _never_forgotten(judgement: Judgement, rows: Floats, sdf: Floats, *, may_repair: bool = True) -> JudgedPlaces:
    del may_repair
    return JUDGE(judgement, rows, sdf, may_repair=False)


JUDGE = Judgement.judge

RULES: dict[str, list[tuple[type, str, Callable[..., object]]]] = {
    "all rules": [],
    "without repairs": [(Judgement, "judge", _never_forgotten)],
    "without slopes": [(Slopes, "after", lambda self, step: None)],
    "without focus": [(Focus, "narrow", lambda self: None)],
}


@contextmanager
def _rules(name: str) -> Iterator[None]:
    with ExitStack() as stack:
        for owner, method, other in RULES[name]:
            stack.enter_context(patch.object(owner, method, other))
        yield


def _learnt(mapper: Mapper, samples: float) -> None:
    while mapper.samples_trained < samples and not mapper.settled:
        mapper.train()


def measure(place: Place) -> list[str]:
    made = place.make(1)
    low, high = made.scene.bounds
    scans = list(made)
    visible = merged(
        (scan.true_hits[((scan.true_hits >= low) & (scan.true_hits <= high)).all(1)] for scan in scans),
        place.voxel_m,
    )
    mapper = Mapper("bench", load_settings(preset=place.preset), "cpu")
    for scan in scans:
        mapper.ingest(scan.points, scan.world_from_sensor)
    told = []

    def score(name: str) -> None:
        told.append(f"{name} {_score(mapper, made, visible, place)}")

    for samples in _SAMPLES:
        _learnt(mapper, samples)
        score(f"{samples / 1e6:g} M")
    _learnt(mapper, np.inf)
    score(f"settled {mapper.samples_trained / 1e6:.1f} M")
    before, noises = mapper.samples_trained, np.random.default_rng(0)
    for scan in scans[-1:] * _RESTS:
        noise = noises.normal(0, 0.1 * place.within_m, scan.points.shape)
        mapper.ingest(scan.points + noise.astype(np.float32), scan.world_from_sensor)
        for _ in range(12):
            if not mapper.settled:
                mapper.train()
        mapper.publish()
    _learnt(mapper, np.inf)
    score(f"rested {(mapper.samples_trained - before) / 1e6:.1f} M more")
    before = mapper.samples_trained
    distance = np.linalg.norm(visible - scans[0].world_from_sensor[:3, 3], axis=1)
    far = visible[distance > np.quantile(distance, 0.7)][::7]
    was = mapper.publish().query(far).sdf
    for scan in scans[: max(3, len(scans) // 8)]:
        mapper.ingest(scan.points, scan.world_from_sensor)
        for _ in range(12):
            if not mapper.settled:
                mapper.train()
        mapper.publish()
    _learnt(mapper, np.inf)
    now = mapper.publish().query(far).sdf
    score(
        f"seen again {(mapper.samples_trained - before) / 1e6:.1f} M more, "
        f"{100 * np.mean(was == now):.0f} % of far places as they were:"
    )
    return told


def _score(mapper: Mapper, made: SimulatedDrive, visible: Doubles, place: Place) -> str:
    settings = ScoreSettings(
        threshold_m=place.within_m, voxel_m=place.voxel_m, samples_max=_SCORED
    )
    with OfflineMap(mapper.publish().record()) as opened:
        scores: MeshScores = score_against_scene(opened.mesh(), made.scene, visible, settings)
    return f"F {100 * scores.f_score:.2f} acc {100 * scores.accuracy_m:.3f} cm out {100*scores.outlier_ratio:.3f} %"


def main(argv: Sequence[str] | None = None) -> int:
    """Measure places with rules."""
    parser = argparse.ArgumentParser(prog="learning", description=__doc__)
    parser.add_argument("--rules", nargs="*", choices=RULES, default=list(RULES))
    parser.add_argument("--places", nargs="*", choices=PLACES, default=list(PLACES))
    options = parser.parse_args(argv)
    for place in options.places:
        for rules in options.rules:
            with _rules(rules):
                for line in measure(PLACES[place]):
                    print(f"{place} | {rules} | {line}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
