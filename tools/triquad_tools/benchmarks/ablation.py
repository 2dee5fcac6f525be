"""``triquad-bench ablation``: the parts of the field, switched off in turn (3QFP's ablation study).

Each variant maps the same drive through the exact street, with the same number of training
samples, in this process.
"""

import numpy as np
from triquad_client import OfflineMap
from triquad_format.records.field_settings import ENCODINGS
from triquad_server.settings import Settings

from triquad_tools.benchmarks.figures import Figure
from triquad_tools.benchmarks.street import settled_mapper
from triquad_tools.evaluation.map_scores import score_street, street_probes
from triquad_tools.evaluation.metrics import score_against_drive
from triquad_tools.simulation.lidar import SimulatedDrive
from triquad_tools.simulation.street import street_drive


def measure_ablation(seed: int, scans: int, step_m: float) -> list[Figure]:
    """Figures of all encodings on a drive of some scans along street ``seed``."""
    drive = street_drive(seed, scans, step_m)
    return [figure for encoding in ENCODINGS for figure in _variant(encoding, drive)]


def _variant(encoding: str, drive: SimulatedDrive) -> list[Figure]:
    """Map a drive with one encoding until all is learnt, and score the map."""
    settings = Settings.model_validate({"field": {"encoding": encoding}})
    mapper = settled_mapper(f"with {encoding}", list(drive), settings)
    epoch = mapper.publish()
    field = score_street(epoch.query, street_probes(drive, np.random.default_rng(0)))
    with OfflineMap(epoch.record()) as opened:
        mesh = score_against_drive(opened.mesh(), drive)
    return [
        Figure(f"{encoding}: parameters", epoch.parameters / 1e6, "M"),
        Figure(f"{encoding}: training samples", mapper.samples_trained / 1e6, "M"),
        Figure(f"{encoding}: SDF error within 0.1 m", 100 * field.sdf_error_m, "cm"),
        Figure(f"{encoding}: gradient angle, median", field.gradient_angle_deg, "deg"),
        Figure(f"{encoding}: completion", 100 * mesh.completion_m, "cm"),
        Figure(f"{encoding}: completion ratio", 100 * mesh.completion_ratio, "%"),
        Figure(f"{encoding}: accuracy", 100 * mesh.accuracy_m, "cm"),
        Figure(f"{encoding}: accuracy ratio", 100 * mesh.accuracy_ratio, "%"),
        Figure(f"{encoding}: F-score", 100 * mesh.f_score, "%"),
    ]
