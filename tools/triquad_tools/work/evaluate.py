"""``triquad-eval``: how good a mesh is."""

import argparse

from triquad_tools.console.command import OK, ToolError, print_line
from triquad_tools.console.report import Row, centimetres, json_text, percent, print_rows
from triquad_tools.evaluation.metrics import MeshScores, ScoreSettings, score_mesh
from triquad_tools.evaluation.references import read_reference
from triquad_tools.mapfiles.meshfile import read_mesh


def work(options: argparse.Namespace) -> int:
    """Score a mesh against true points."""
    mesh = read_mesh(options.mesh)
    if not len(mesh.faces):
        raise ToolError(f"{options.mesh}: has no faces; a cloud can only be a --reference")
    settings = ScoreSettings(options.threshold, accuracy_cut_m=2 * options.threshold)
    reference = read_reference(options.reference, settings.voxel_m, options.range_min)
    scores = score_mesh(mesh, reference, settings)
    if options.json:
        print_line(json_text(scores))
    else:
        print_rows(str(options.mesh), _rows(scores))
    return OK


def _rows(scores: MeshScores) -> list[Row]:
    return [
        Row("accuracy", centimetres(scores.accuracy_m), "mean, mesh to truth, outliers left out"),
        Row("accuracy, median", centimetres(scores.accuracy_median_m)),
        Row("accuracy ratio", percent(scores.accuracy_ratio), "outliers left out"),
        Row("completion", centimetres(scores.completion_m), "mean, truth to mesh"),
        Row("completion ratio", percent(scores.completion_ratio)),
        Row("F-score", percent(scores.f_score), "of both ratios"),
        Row("outliers", percent(scores.outlier_ratio), "mesh beyond the accuracy cut"),
    ]
