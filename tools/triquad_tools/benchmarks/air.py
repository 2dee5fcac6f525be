"""``triquad-bench`` of open air: what of it is known, and what rays without a return cost."""

from collections.abc import Iterable
from functools import partial

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.records.status import Status
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings

from triquad_tools.benchmarks.figures import Figure, seconds, typical
from triquad_tools.benchmarks.street import LENGTH_M, SCANS
from triquad_tools.console.progress import progress
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive, SimulatedScan, drive
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.street import street

_UPWARDS = Lidar(columns=1024, elevation_max_deg=45.0)  # of 66,000 rays a third meet nothing
_HEIGHTS_M = (1.6, 3.4)  # over the road; the second is 1.6 m over the sensor
_LANE_M = (-3.1, -0.1)  # from and to which y it goes
_CLEAR_M = 0.3
_POINTS = 100_000


def measure_air(seed: int) -> list[Figure]:
    """Figures of a drive whose lidar looks up, without and with its rays without a return."""
    settings = Settings()
    scene = street(seed, LENGTH_M)
    poses = drive(scene, SCANS, LENGTH_M / SCANS)
    scans = list(SimulatedDrive(scene, _UPWARDS, poses, seed=seed))
    figures: list[Figure] = []
    for words, believed in (("without no_return", False), ("with no_return", True)):
        mapper = Mapper("bench", settings, "cpu")
        taken_s = _take_in(mapper, scans, believed)
        figures += _unknown(mapper, scene, words, at_most=10 if believed else None)
        figures.append(Figure(f"take in a scan, {words}", 1e3 * typical(taken_s), "ms"))
        blocks = sum(region.evidence.blocks for region in mapper.regions)
        figures.append(Figure(f"blocks of evidence, {words}", blocks / 1e3, "k"))
    return figures


def _take_in(mapper: Mapper, scans: Iterable[SimulatedScan], believed: bool) -> list[float]:
    """How long each scan takes."""
    taken_s: list[float] = []
    with progress("open air", SCANS) as report:
        for number, scan in enumerate(scans, start=1):
            no_return = scan.no_return if believed else None
            ingest = partial(mapper.ingest, scan.points, scan.world_from_sensor)
            taken_s.append(seconds(partial(ingest, no_return=no_return)))
            report(number, f"{number} of {SCANS} scans")
    return taken_s


def _unknown(mapper: Mapper, scene: Scene, words: str, at_most: float | None) -> list[Figure]:
    """The share of open air over the lane that is unknown, by height."""
    epoch = mapper.publish()
    rng = np.random.default_rng(0)
    figures: list[Figure] = []
    for height_m in _HEIGHTS_M:
        points = _open_air(scene, height_m, rng)
        share = float((epoch.status(points) == Status.UNKNOWN).mean())
        name = f"unknown of open air {height_m:g} m over the lane, {words}"
        figures.append(Figure(name, 100 * share, "%", at_most=at_most))
    return figures


def _open_air(scene: Scene, height_m: float, rng: np.random.Generator) -> Doubles:
    """Random points [N, 3] over the lane, clear of everything."""
    low, high = (0.0, _LANE_M[0], height_m), (LENGTH_M, _LANE_M[1], height_m)
    points = rng.uniform(low, high, (_POINTS, 3))
    clear: Doubles = points[scene.sdf(points) > _CLEAR_M]
    return clear
