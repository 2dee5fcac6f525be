"""Scans that a map has not seen, put back from guesses that are off by a known offset."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from triquad_format.records.arrays import Doubles
from triquad_map.questions.align import Alignment, AlignOptions, align
from triquad_map.view import MapView
from triquad_server.settings import Settings
from triquad_tools.sensors.sweep import PosedScan

from bench.recorded import recorded_scans
from bench.street import settled_mapper

_TRIES = 5  # guesses for each scan
_SEED = 4  # of the guesses
_GOOD_M, _GOOD_DEG = 0.05, 0.5


@dataclass(frozen=True)
class Offset:
    """How far the guess is off, in a random direction and about a random axis."""

    metres: float
    degrees: float


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

    @property
    def good(self) -> bool:
        """Whether it converged, and to within 5 cm and half a degree of the given pose."""
        near = self.error_m <= _GOOD_M and self.error_deg <= _GOOD_DEG
        return self.alignment.converged and near


def recorded(path: Path, scans: int | None = None, settings: Settings | None = None) -> PlacedScans:
    """The map of a recorded folder (of its first ``scans``) without every 7th, and those."""
    of_folder = recorded_scans(path, scans)
    mapper = settled_mapper(path.name, of_folder.mapped, settings)
    return PlacedScans(mapper.publish(), of_folder.withheld)


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
    alignment = align(view, points, guess, options=AlignOptions())
    found, true = alignment.world_from_sensor, scan.world_from_sensor
    chord = float(np.linalg.norm(found[:3, :3] - true[:3, :3])) / np.sqrt(8.0)
    return Attempt(
        alignment,
        error_m=float(np.linalg.norm(found[:3, 3] - true[:3, 3])),
        error_deg=float(np.degrees(2.0 * np.arcsin(min(chord, 1.0)))),
    )
