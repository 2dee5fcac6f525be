"""``triquad-bench`` of localisation: unseen scans are put back where they were taken."""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from triquad_format.records.arrays import Doubles
from triquad_map.questions.align import Alignment, AlignOptions, align
from triquad_map.view import MapView
from triquad_sensors.sweep import PosedScan
from triquad_server.settings import Settings

from triquad_tools.benchmarks.figures import Figure
from triquad_tools.benchmarks.street import BenchStreet, settled_mapper
from triquad_tools.console.lines import print_remark
from triquad_tools.recordings.cloud import is_withheld, points_in_range
from triquad_tools.recordings.folders.kitti import read_kitti_folder

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
class RecordedScans:
    """Scans of a recorded drive: those to map, and those that the map is not to see."""

    mapped: tuple[PosedScan, ...]
    withheld: tuple[PosedScan, ...]


@dataclass(frozen=True)
class PlacedScans:
    """A map and scans that it has not seen."""

    view: MapView
    scans: tuple[PosedScan, ...]


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
        ToolError: the folder cannot be read.
    """
    check_recorded("align", folder)
    figures = _figures("street", on_street(made))
    return figures if folder is None else figures + _figures(folder.name, recorded(folder))


def on_street(made: BenchStreet) -> PlacedScans:
    """The street's map, and scans from beside the drive."""
    view = settled_mapper("the street", made.scans).publish()
    rng = np.random.default_rng(_SEED)
    chosen = np.linspace(0, len(made.drive) - 1, _STREET_SCANS).astype(int)
    poses = (displaced(made.drive.poses[index], Offset(0.4, 3.0), rng) for index in chosen)
    scan, scene = made.drive.sensor.scan, made.drive.scene
    return PlacedScans(view, tuple(scan(scene, pose, rng) for pose in poses))


def recorded(path: Path, scans: int | None = None, settings: Settings | None = None) -> PlacedScans:
    """The map of a recorded folder (of its first ``scans``) without every 7th, and those."""
    of_folder = recorded_scans(path, scans)
    mapper = settled_mapper(path.name, of_folder.mapped, settings)
    return PlacedScans(mapper.publish(), of_folder.withheld)


def check_recorded(part: str, folder: Path | None) -> None:
    """Try a folder before all else, which takes minutes; tell where a part has none.

    Raises:
        ToolError: it cannot be read.
    """
    if folder is None:
        print_remark(f"{part}: recorded scans are left out: give --recorded FOLDER")
    else:
        read_kitti_folder(folder)


def recorded_scans(path: Path, scans: int | None = None) -> RecordedScans:
    """The scans of a folder (the first ``scans`` of them), every 7th apart.

    Raises:
        ToolError: the folder cannot be read.
    """
    folder = read_kitti_folder(path)
    mapped: list[PosedScan] = []
    withheld: list[PosedScan] = []
    indices = range(len(folder))[:scans]
    for index, whole in zip(indices, folder.read(indices), strict=True):
        near = points_in_range(whole.points, _RANGE_MIN_M)
        scan = PosedScan(near, whole.world_from_sensor)
        (withheld if is_withheld(index, _SKIP_EVERY) else mapped).append(scan)
    return RecordedScans(tuple(mapped), tuple(withheld))


def attempts(placed: PlacedScans, offset: Offset, tries: int = _TRIES) -> list[Attempt]:
    """Align each scan from several guesses, drawn always the same."""
    rng = np.random.default_rng(_SEED)
    return [
        _attempt(placed.view, scan, displaced(scan.world_from_sensor, offset, rng))
        for scan in placed.scans
        for _ in range(tries)
    ]


def displaced(pose: Doubles, offset: Offset, rng: np.random.Generator) -> Doubles:
    """A pose [4, 4] moved and turned (about itself) by an offset at random."""
    shift, axis = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    turn = Rotation.from_rotvec(offset.degrees * axis, degrees=True).as_matrix()
    moved: Doubles = pose.copy()
    moved[:3, :3] = turn @ pose[:3, :3]
    moved[:3, 3] += offset.metres * shift
    return moved


def _attempt(view: MapView, scan: PosedScan, guess: Doubles) -> Attempt:
    points = np.asarray(scan.points, np.float64)
    started = time.perf_counter()
    alignment = align(view, points, guess, options=AlignOptions())
    seconds = time.perf_counter() - started
    found, true = alignment.world_from_sensor, scan.world_from_sensor
    chord = float(np.linalg.norm(found[:3, :3] - true[:3, :3])) / np.sqrt(8.0)
    return Attempt(
        alignment,
        error_m=float(np.linalg.norm(found[:3, 3] - true[:3, 3])),
        error_deg=float(np.degrees(2.0 * np.arcsin(min(chord, 1.0)))),
        seconds=seconds,
    )


def _figures(name: str, placed: PlacedScans) -> list[Figure]:
    first = placed.scans[0]
    _attempt(placed.view, first, first.world_from_sensor)  # compiles, and is not timed
    optimum = [_attempt(placed.view, one, one.world_from_sensor).error_m for one in placed.scans]
    tail_cm = 100 * float(np.quantile(optimum, 0.95))
    figures = [Figure(f"{name}: optimum from given pose, 95 %", tail_cm, "cm")]
    for number, offset in enumerate(OFFSETS):
        results = attempts(placed, offset)
        title = f"{name}, {offset.metres:g} m and {offset.degrees:g} deg off"
        good = np.array([one.good for one in results])
        wrong = np.array([one.alignment.converged for one in results]) & ~good
        figures += [
            Figure(f"{title}: aligned", 100 * good.mean(), "%", at_least=None if number else 95),
            Figure(f"{title}: wrong but said to be right", 100 * wrong.mean(), "%"),
        ]
        if number == 0:
            figures += _spread(f"{title}: position", [100 * one.error_m for one in results], "cm")
            figures += _spread(f"{title}: rotation", [one.error_deg for one in results], "deg")
            figures += _spread(
                f"{title}: time", [1e3 * one.seconds for one in results], "ms", tail_at_most=100
            )
    return figures


def _spread(
    title: str, values: list[float], unit: str, tail_at_most: float | None = None
) -> list[Figure]:
    median, tail = np.quantile(values, [0.5, 0.95]).tolist()
    return [
        Figure(f"{title}, median", median, unit),
        Figure(f"{title}, 95 %", tail, unit, at_most=tail_at_most),
    ]
