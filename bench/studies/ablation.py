"""``python -m bench.studies.ablation``: the parts of the field, switched off in turn.

This is the ablation study of 3QFP.

Each variant maps the same drive through the exact street, with the same number of training
samples, in this process.
"""

import argparse
import sys
from collections.abc import Sequence

import numpy as np
from triquad_client import OfflineMap
from triquad_format.records.field_settings import ENCODINGS
from triquad_server.settings import Settings
from triquad_tools.console.arguments import count, positive, seed
from triquad_tools.console.report import Row, print_rows
from triquad_tools.evaluation.metrics import ScoreSettings, score_mesh
from triquad_tools.simulation.lidar import SimulatedDrive
from triquad_tools.simulation.street import street_drive

from bench.figures import Figure
from bench.street import settled_mapper
from bench.street_scores import STREET_VOXEL_M, score_street, street_probes


def measure_ablation(seed: int, scans: int, step_m: float) -> list[Figure]:
    """Return figures of all encodings on a drive of some scans along street ``seed``."""
    drive = street_drive(seed, scans, step_m)
    return [figure for encoding in ENCODINGS for figure in _variant(encoding, drive)]


def _variant(encoding: str, drive: SimulatedDrive) -> list[Figure]:
    """Map a drive with one encoding until all is learnt, and score the map."""
    settings = Settings.model_validate({"field": {"encoding": encoding}})
    mapper = settled_mapper(f"with {encoding}", list(drive), settings)
    epoch = mapper.publish()
    field = score_street(epoch.query, street_probes(drive, np.random.default_rng(0)))
    with OfflineMap(epoch.record()) as opened:
        visible = drive.true_hits(STREET_VOXEL_M)
        mesh = score_mesh(opened.mesh(), visible, ScoreSettings(), drive.scene.sdf)
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


def main(argv: Sequence[str] | None = None) -> int:
    """Measure all encodings, and print their figures."""
    parser = argparse.ArgumentParser(prog="ablation", description=__doc__)
    parser.add_argument("--seed", type=seed, default=1, help="of the street (default: 1)")
    parser.add_argument("--scans", type=count, default=60, help="of the drive (default: 60)")
    parser.add_argument("--step", type=positive, default=1.0, help="between them [m] (default: 1)")
    options = parser.parse_args(argv)
    figures = measure_ablation(options.seed, options.scans, options.step)
    print_rows(f"ablation, street {options.seed}", [Row(one.name, one.shown) for one in figures])
    return 0


if __name__ == "__main__":
    sys.exit(main())
