"""``triquad-bench fill``: the mesh where scans lie far apart, with its holes filled and without."""

import numpy as np
from triquad_client import Mesh, OfflineMap

from triquad_tools.benchmarks.figures import Figure
from triquad_tools.benchmarks.street import BenchStreet, settled_mapper
from triquad_tools.evaluation.metrics import mean_or_nan, mesh_area_m2, sample_mesh

_FILL_M = 1.0
_WANTED = {5: 98.0, 10: 95.5}  # the least F-score, by one scan of how many
_RIGHT_M = 0.1
_RIGHT_SHARE = 90.0  # of the filled area, the least
_SAMPLES = 200_000


def measure_fill(made: BenchStreet) -> list[Figure]:
    """Figures of meshes of every fifth and every tenth scan, against all that the drive saw."""
    figures = []
    for every, wanted in _WANTED.items():
        epoch = settled_mapper(f"one scan of {every}", made.scans[::every]).publish()
        with OfflineMap(epoch.record()) as opened:
            plain = opened.mesh(made.drive.scene.box)
            filled = opened.mesh(made.drive.scene.box, fill_m=_FILL_M)
        figures += _figures(made, plain, filled, f"one scan of {every}", wanted)
    return figures


def _figures(
    made: BenchStreet, plain: Mesh, filled: Mesh, name: str, wanted: float
) -> list[Figure]:
    before, after = made.mesh_scores(plain), made.mesh_scores(filled)
    holes = Mesh(filled.vertices, filled.faces[filled.filled])
    right = 100 * _right_share(made, holes)
    return [
        Figure(f"F-score at 10 cm, {name}", 100 * before.f_score, "%"),
        Figure("the same, holes filled", 100 * after.f_score, "%", at_least=wanted),
        Figure(f"surface within 10 cm of the mesh, {name}", 100 * before.completion_ratio, "%"),
        Figure("the same, holes filled", 100 * after.completion_ratio, "%"),
        Figure(f"filled, {name}", mesh_area_m2(holes), "m2"),
        Figure("share of it that is right within 10 cm", right, "%", at_least=_RIGHT_SHARE),
    ]


def _right_share(made: BenchStreet, holes: Mesh) -> float:
    """The share of a mesh's area that is nearer than so much to the exact surface."""
    if not len(holes.faces):
        return float("nan")
    places = sample_mesh(holes, _SAMPLES, np.random.default_rng(0))
    return mean_or_nan(np.abs(made.drive.scene.sdf(places)) < _RIGHT_M)
