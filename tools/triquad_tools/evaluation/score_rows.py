"""Scores as lines of tables."""

from triquad_tools.console.report import Row, centimetres, percent
from triquad_tools.evaluation.metrics import MeshScores
from triquad_tools.evaluation.withheld_scores import WithheldScores

_TRUSTED = "SURFACE points"  # those that a user would trust


def mesh_rows(scores: MeshScores) -> list[Row]:
    """Return the scores of a mesh as lines of a table."""
    return [
        Row("accuracy", centimetres(scores.accuracy_m), "mean, mesh to truth, outliers left out"),
        Row("accuracy, median", centimetres(scores.accuracy_median_m)),
        Row("accuracy ratio", percent(scores.accuracy_ratio), "outliers left out"),
        Row("completion", centimetres(scores.completion_m), "mean, truth to mesh"),
        Row("completion ratio", percent(scores.completion_ratio)),
        Row("F-score", percent(scores.f_score), "of both ratios"),
        Row("outliers", percent(scores.outlier_ratio), "mesh beyond the accuracy cut"),
    ]


def withheld_rows(scores: WithheldScores) -> list[Row]:
    """Return the scores of a map at withheld scans as lines of a table."""
    return [
        Row("SURFACE", percent(scores.surface_ratio), "of all points"),
        Row("UNKNOWN", percent(scores.unknown_ratio), "of all points"),
        Row("|SDF|, median", centimetres(scores.sdf_median_m), "all points"),
        Row("|SDF|, 90 %", centimetres(scores.sdf_p90_m), "all points"),
        Row("|SDF|, median", centimetres(scores.surface_sdf_median_m), _TRUSTED),
        Row("|SDF|, 90 %", centimetres(scores.surface_sdf_p90_m), _TRUSTED),
        Row("points", f"{scores.points:,}"),
    ]
