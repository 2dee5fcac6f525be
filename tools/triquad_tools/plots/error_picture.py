"""Pictures of errors: a mesh coloured by its distance from the truth, a map's answers at points.

What is missing is orange, which is in no scale of blues; what lies beyond the scale has a colour of
its own.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles
from triquad_format.records.status import Status

from triquad_tools.console.command import ToolError
from triquad_tools.console.report import percent
from triquad_tools.evaluation.map_scores import WithheldAnswer, WithheldScores
from triquad_tools.evaluation.metrics import Comparison, is_scored, mean_or_nan
from triquad_tools.plots.mesh_sheet import Legend, save_mesh_sheet
from triquad_tools.plots.mesh_view import Picture, view_along
from triquad_tools.plots.plan import Scale

MISSING = "#e69f00"
BEYOND = "#8b1a1a"
ERRORS = LinearSegmentedColormap.from_list(
    "errors", ["#c1dcf0", "#629adc", "#2653b1", "#180c68"]
).with_extremes(over=BEYOND)
"""From no error to the greatest, light to dark."""

_WITHHELD_HIGH_M = 0.2


def draw_mesh_errors(title: str, comparison: Comparison, path: Path) -> None:
    """Draw a mesh by its distance from the truth, and what of the truth it lacks.

    Raises:
        OSError: ``path`` cannot be written.
    """
    mesh, scores, settings = comparison.mesh, comparison.scores, comparison.settings
    scored = is_scored(mesh.vertices, comparison.truth.points, settings)
    distances_m = np.zeros(len(mesh.vertices))
    distances_m[scored] = comparison.truth.distances(np.asarray(mesh.vertices[scored], np.float64))
    faces = mesh.faces[scored[mesh.faces].all(axis=1)]
    lacking = np.asarray(comparison.missing, np.float64)
    shown = np.concatenate([mesh.vertices[np.unique(faces)], lacking])
    picture = Picture(view_along(shown, mesh.vertices[faces]))
    high_m = settings.accuracy_cut_m
    picture.add_mesh(mesh.vertices, faces, error_colours(distances_m, high_m))
    picture.add_points(lacking, np.tile(to_rgb(MISSING), (len(lacking), 1)))
    beyond = bool((distances_m > high_m).any())
    aside = 100.0 * (1.0 - len(faces) / max(len(mesh.faces), 1))
    legend = Legend(
        title,
        Scale("mesh to truth, cm (line: threshold)", ERRORS, 0.0, 100.0 * high_m),
        beyond=(False, beyond),
        notes=[
            f"farther than the scale: {percent(scores.outlier_ratio)}" if beyond else "",
            f"outside of the truth's box, not scored: {aside:.2g} %" if aside else "",
        ],
        limit=100.0 * settings.threshold_m,
        named=[(MISSING, f"no mesh:\n{percent(1.0 - scores.completion_ratio)}\nof the truth")],
    )
    save_mesh_sheet(path, picture, legend)


def draw_withheld(
    title: str, answers: Sequence[WithheldAnswer], scores: WithheldScores, path: Path
) -> None:
    """Draw the points of scans that a map never saw, by how far from surface it says they are.

    Raises:
        ToolError: there are no points.
        OSError: ``path`` cannot be written.
    """
    if not scores.points:
        raise ToolError(f"{path} is not written: the withheld scans have no points in range")
    distances_m = np.concatenate([answer.distance_m for answer in answers])
    unknown = np.concatenate([answer.status for answer in answers]) == Status.UNKNOWN
    points = np.concatenate([answer.points for answer in answers])
    colours = error_colours(distances_m, _WITHHELD_HIGH_M)
    colours[unknown] = to_rgb(MISSING)
    picture = Picture(view_along(points, np.zeros((0, 3, 3))))
    picture.add_points(points, colours)
    more = mean_or_nan(~unknown & (distances_m > _WITHHELD_HIGH_M))
    legend = Legend(
        title,
        Scale("map at the points: |distance| in cm", ERRORS, 0.0, 100.0 * _WITHHELD_HIGH_M),
        beyond=(False, bool(more)),
        notes=[f"farther than the scale: {percent(more)}" if more else ""],
        named=[(MISSING, f"UNKNOWN:\n{percent(scores.unknown_ratio)}")],
    )
    save_mesh_sheet(path, picture, legend)


def error_colours(distances_m: NDArray[np.floating], high_m: float) -> Doubles:
    """Return colours ``[N, 3]``, sRGB in [0, 1], of distances ``[N]``, the greatest ``high_m``."""
    return np.asarray(ERRORS(np.asarray(distances_m, np.float64) / high_m)[:, :3], np.float64)
