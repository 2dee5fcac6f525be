"""``triquad-bench`` of borders: a street across them, beside the same one amid a region.

All maps learn the same scans. Only their poses are moved, and what is asked is moved along.
"""

import io
from dataclasses import dataclass

import numpy as np
from triquad_client import Mesh, OfflineMap
from triquad_format.mapfile.writer import write_map
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import BLOCK_VOXELS, FieldSettings
from triquad_map.view import FieldAnswer
from triquad_sensors.sweep import PosedScan
from triquad_server.epochs.epoch import Epoch
from triquad_server.settings import Settings

from triquad_tools.benchmarks.figures import Figure
from triquad_tools.benchmarks.street import LENGTH_M, BenchStreet, settled_mapper
from triquad_tools.evaluation.map_scores import score_street

_MIDDLE = "in the middle of a region"
_F_LOST = 0.2  # points of the F-score that a border may cost
_TIMES = 1.03  # that it may raise the error of the mesh


@dataclass(frozen=True)
class _Scores:
    """How good a settled map of the street is."""

    f_score: float
    accuracy_m: float
    accuracy_median_m: float
    sdf_error_m: float
    file_bytes: int
    samples_trained: int


def measure_borders(made: BenchStreet) -> list[Figure]:
    """Figures of the street in the middle of a region, across a border and across a corner."""
    settings = Settings()
    x_m, y_m = _to_corner(settings.field)
    middle = _scores(_MIDDLE, made, np.zeros(3), settings)
    figures = _figures(_MIDDLE, middle)
    for name, offset in (
        ("across a border", np.array([x_m, 0.0, 0.0])),
        ("across a corner of four", np.array([x_m, y_m, 0.0])),
    ):
        scores = _scores(name, made, offset, settings)
        lost = 100 * (middle.f_score - scores.f_score)
        times = scores.accuracy_m / middle.accuracy_m
        figures += [
            *_figures(name, scores),
            Figure(f"points of F lost {name}", lost, "", at_most=_F_LOST),
            Figure(f"error of the mesh {name}, times", times, "", at_most=_TIMES),
        ]
    return figures


def _to_corner(settings: FieldSettings) -> tuple[float, float]:
    """How far the middle of the street is from a corner of regions, along x and y.

    Whole blocks: so the lattices of voxels lie on the street everywhere as they do in the middle.
    """
    block_m = BLOCK_VOXELS * settings.leaf_m
    corner_m = settings.region_pitch_m / 2
    return block_m * round((corner_m - LENGTH_M / 2) / block_m), block_m * round(corner_m / block_m)


def _scores(name: str, made: BenchStreet, offset: Doubles, settings: Settings) -> _Scores:
    """Scores of a map of the street that is moved by an ``offset`` [3], metres."""
    shift = np.eye(4)
    shift[:3, 3] = offset
    scans = [PosedScan(scan.points, shift @ scan.world_from_sensor) for scan in made.scans]
    mapper = settled_mapper(f"the street {name}", scans, settings)
    epoch = mapper.publish()

    def query(points: Doubles, gradient: bool = False) -> FieldAnswer:
        return epoch.query(points + offset, gradient)

    field = score_street(query, made.probes)
    mesh = made.mesh_scores(_mesh(epoch, made, offset))
    return _Scores(
        f_score=mesh.f_score,
        accuracy_m=mesh.accuracy_m,
        accuracy_median_m=mesh.accuracy_median_m,
        sdf_error_m=field.sdf_error_m,
        file_bytes=write_map(epoch.record(), io.BytesIO()).bytes,
        samples_trained=mapper.samples_trained,
    )


def _mesh(epoch: Epoch, made: BenchStreet, offset: Doubles) -> Mesh:
    """The mesh of the street, back where it was."""
    low, high = (made.drive.scene.bounds + offset).tolist()
    with OfflineMap(epoch.record()) as opened:
        mesh = opened.mesh((low, high))
    return Mesh(mesh.vertices - offset, mesh.faces)


def _figures(name: str, scores: _Scores) -> list[Figure]:
    return [
        Figure(f"F-score {name}", 100 * scores.f_score, "%"),
        Figure(f"accuracy {name}", 100 * scores.accuracy_m, "cm"),
        Figure(f"accuracy {name}, median", 100 * scores.accuracy_median_m, "cm"),
        Figure(f"SDF error {name}", 100 * scores.sdf_error_m, "cm"),
        Figure(f"map file {name}", scores.file_bytes / 1e6, "MB"),
        Figure(f"training samples {name}", scores.samples_trained / 1e6, "M"),
    ]
