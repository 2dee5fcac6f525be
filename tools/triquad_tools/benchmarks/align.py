"""``triquad-bench`` of localisation: unseen scans are put back where they were taken."""

import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from triquad_map.questions.align import Alignment, AlignOptions, align
from triquad_map.view import MapView

from triquad_tools.benchmarks.figures import Figure
from triquad_tools.benchmarks.street import BenchStreet, settled_mapper
from triquad_tools.recordings.cloud import is_withheld, points_in_range
from triquad_tools.recordings.kitti import read_folder

_SKIP_EVERY = 7
_RANGE_MIN_M = 2.0  # nearer is the vehicle's own body
_STREET_SCANS = 6  # that are made anew, beside the drive
_TRIES = 5  # guesses for each scan
_SEED = 4  # of the guesses
_GOOD_M, _GOOD_DEG = 0.05, 0.5


@dataclass(frozen=True)
class Offset:
    """How far the guess is off, in a random direction and about a random axis."""

    metres: float
    degrees: float


OFFSETS = (Offset(0.5, 5.0), Offset(1.0, 10.0), Offset(2.0, 15.0))


@dataclass(frozen=True)
class PlacedScan:
    """A scan, and where it was taken."""

    points: NDArray[np.float64]  # [N, 3] metres, sensor frame
    world_from_sensor: NDArray[np.float64]  # [4, 4]


@dataclass(frozen=True)
class PlacedScans:
    """A map and scans that it has not seen."""

    view: MapView
    scans: tuple[PlacedScan, ...]


@dataclass(frozen=True)
class Attempt:
    """One alignment and how far it is from the given pose."""

    alignment: Alignment
    error_m: float
    error_deg: float
    seconds: float

    @property
    def good(self) -> bool:
        """Whether it converged, and to within 5 cm and half a degree of the given pose."""
        near = self.error_m <= _GOOD_M and self.error_deg <= _GOOD_DEG
        return self.alignment.converged and near


def measure_align(made: BenchStreet, folder: Path | None) -> list[Figure]:
    """Figures on the street and, if given, on a recorded folder whose every 7th scan is withheld.

    Raises:
        ScanFolderError: the folder cannot be read.
    """
    if folder is None:
        print("align: recorded scans are left out: give --recorded FOLDER", file=sys.stderr)
    else:
        read_folder(folder)  # before all else, which takes minutes
    figures = _figures("street", on_street(made))
    return figures if folder is None else figures + _figures(folder.name, recorded(folder))


def on_street(made: BenchStreet) -> PlacedScans:
    """The street's map, and scans from beside the drive."""
    view = settled_mapper("the street", made.scans).publish()
    rng = np.random.default_rng(_SEED)
    drive = made.drive
    scans: list[PlacedScan] = []
    for index in np.linspace(0, len(drive) - 1, _STREET_SCANS).astype(int):
        pose = displaced(drive.poses[index], Offset(0.4, 3.0), rng)
        scan = drive.lidar.scan(drive.scene, pose, rng)
        scans.append(PlacedScan(scan.points.astype(np.float64), pose))
    return PlacedScans(view, tuple(scans))


def recorded(path: Path, scans: int | None = None) -> PlacedScans:
    """The map of a recorded folder (of its first ``scans``) without every 7th, and those."""
    folder = read_folder(path)
    mapped: list[PlacedScan] = []
    withheld: list[PlacedScan] = []
    for index, pose in enumerate(folder.poses[:scans]):
        points = points_in_range(folder.read_points(index), _RANGE_MIN_M)
        scan = PlacedScan(points.astype(np.float64), pose)
        (withheld if is_withheld(index, _SKIP_EVERY) else mapped).append(scan)
    return PlacedScans(settled_mapper(path.name, mapped).publish(), tuple(withheld))


def attempts(placed: PlacedScans, offset: Offset, tries: int = _TRIES) -> list[Attempt]:
    """Align each scan from several guesses, drawn always the same."""
    rng = np.random.default_rng(_SEED)
    return [
        _attempt(placed.view, scan, displaced(scan.world_from_sensor, offset, rng))
        for scan in placed.scans
        for _ in range(tries)
    ]


def displaced(
    pose: NDArray[np.float64], offset: Offset, rng: np.random.Generator
) -> NDArray[np.float64]:
    """A pose [4, 4] moved and turned (about itself) by an offset at random."""
    shift, axis = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    angle = np.radians(offset.degrees)
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
    moved: NDArray[np.float64] = pose.copy()
    moved[:3, :3] = turn @ pose[:3, :3]
    moved[:3, 3] += offset.metres * shift
    return moved


def _attempt(view: MapView, scan: PlacedScan, guess: NDArray[np.float64]) -> Attempt:
    started = time.perf_counter()
    alignment = align(view, scan.points, guess, AlignOptions())
    seconds = time.perf_counter() - started
    found, true = alignment.world_from_sensor, scan.world_from_sensor
    chord = float(np.linalg.norm(found[:3, :3] - true[:3, :3])) / np.sqrt(8.0)
    return Attempt(
        alignment,
        float(np.linalg.norm(found[:3, 3] - true[:3, 3])),
        float(np.degrees(2.0 * np.arcsin(min(chord, 1.0)))),
        seconds,
    )


def _figures(name: str, placed: PlacedScans) -> list[Figure]:
    scan = placed.scans[0]
    _attempt(placed.view, scan, scan.world_from_sensor)  # compiles, and is not timed
    optimum = [_attempt(placed.view, one, one.world_from_sensor) for one in placed.scans]
    figures = [
        Figure(f"{name}: optimum from given pose, 95 %", *_centimetres(optimum)),
    ]
    for number, offset in enumerate(OFFSETS):
        results = attempts(placed, offset)
        title = f"{name}, {offset.metres:g} m and {offset.degrees:g} deg off"
        good = 100.0 * float(np.mean([one.good for one in results]))
        wrong = [one.alignment.converged and not one.good for one in results]
        figures += [
            Figure(f"{title}: aligned", good, "%", at_least=None if number else 95),
            Figure(f"{title}: wrong but said to be right", 100.0 * float(np.mean(wrong)), "%"),
        ]
        if number == 0:
            figures += _details(title, results)
    return figures


def _centimetres(results: Iterable[Attempt]) -> tuple[float, str]:
    return 100.0 * float(np.percentile([one.error_m for one in results], 95)), "cm"


def _details(title: str, results: Sequence[Attempt]) -> list[Figure]:
    metres = np.array([one.error_m for one in results])
    degrees = np.array([one.error_deg for one in results])
    seconds = np.array([one.seconds for one in results])
    return [
        Figure(f"{title}: position, median", 100.0 * float(np.median(metres)), "cm"),
        Figure(f"{title}: position, 95 %", 100.0 * float(np.percentile(metres, 95)), "cm"),
        Figure(f"{title}: rotation, median", float(np.median(degrees)), "deg"),
        Figure(f"{title}: rotation, 95 %", float(np.percentile(degrees, 95)), "deg"),
        Figure(f"{title}: time, median", 1e3 * float(np.median(seconds)), "ms"),
        Figure(f"{title}: time, 95 %", 1e3 * float(np.percentile(seconds, 95)), "ms", at_most=100),
    ]
