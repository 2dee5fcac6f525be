"""The parts of the field, switched off in turn (3QFP, table of the ablation study).

Run as ``python -m triquad_tools.benchmarks.ablation``. Each variant maps the same drive through
the exact street, with the same number of training samples, in this process.
"""

import argparse
import sys
from dataclasses import dataclass

import numpy as np
from triquad_format.records.field_settings import ENCODINGS

from triquad_tools.evaluation.map_scores import StreetScores, score_street, street_probes
from triquad_tools.evaluation.meshfile import Mesh
from triquad_tools.evaluation.metrics import MeshScores, ScoreSettings, score_against_scene
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive, drive
from triquad_tools.simulation.street import street

_REFERENCE_M = 0.05
_SAMPLES_MAX = 3_000_000


@dataclass(frozen=True)
class Variant:
    """How one variant did."""

    encoding: str
    parameters: int
    samples_trained: int
    field: StreetScores
    mesh: MeshScores


def run_variant(encoding: str, through: SimulatedDrive) -> Variant:
    """Map a drive with one encoding until all is learnt, and score the map."""
    from triquad_server.mapping.mapper import Mapper
    from triquad_server.mesh.epoch_mesh import EpochMesh
    from triquad_server.settings import MeshSettings, parse_settings

    mapper = Mapper("ablation", parse_settings({"field": {"encoding": encoding}}), "cpu")
    for scan in through:
        mapper.ingest(scan.points, scan.world_from_sensor)
    while not mapper.settled:
        mapper.train()
    epoch = mapper.publish()
    mesh = EpochMesh(epoch, MeshSettings())
    rng = np.random.default_rng(0)
    vertices: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    count = 0
    for x, y, z in mesh.tiles(np.full(3, -np.inf), np.full(3, np.inf)).tolist():
        tile = mesh.tile((x, y, z))
        vertices.append(tile.vertices + tile.origin)
        faces.append(tile.faces + count)
        count += len(tile.vertices)
    return Variant(
        encoding,
        epoch.parameters,
        mapper.samples_trained,
        score_street(epoch.query, street_probes(through, rng)),
        score_against_scene(
            Mesh(np.concatenate(vertices), np.concatenate(faces)),
            through.scene,
            through.true_hits(_REFERENCE_M),
            ScoreSettings(samples_max=_SAMPLES_MAX),
            rng,
        ),
    )


def main(argv: list[str] | None = None) -> int:
    """Map with all variants and print a table."""
    parser = argparse.ArgumentParser(prog="triquad_tools.benchmarks.ablation", description=__doc__)
    parser.add_argument("--scans", type=int, default=60, help="scans of the drive")
    parser.add_argument("--step", type=float, default=1.0, help="metres between scans")
    parser.add_argument("--seed", type=int, default=1, help="seed of the street")
    options = parser.parse_args(argv)
    scene = street(options.seed)
    through = SimulatedDrive(scene, Lidar(), drive(scene, options.scans, options.step))
    print(
        "encoding   parameters  samples  sdf error  angle  completion       accuracy         F"
        "\n                          (M)       (cm)  (deg)  (cm)  ratio %    (cm)  ratio %    %",
    )
    for encoding in ENCODINGS:
        result = run_variant(encoding, through)
        mesh = result.mesh
        print(
            f"{encoding:9}  {result.parameters:10,}  {result.samples_trained / 1e6:7.1f}"
            f"  {100 * result.field.sdf_error_m:9.2f}  {result.field.gradient_angle_deg:5.1f}"
            f"  {100 * mesh.completion_m:4.1f}  {100 * mesh.completion_ratio:7.1f}"
            f"  {100 * mesh.accuracy_m:6.2f}  {100 * mesh.accuracy_ratio:7.1f}"
            f"  {100 * mesh.f_score:6.1f}",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
