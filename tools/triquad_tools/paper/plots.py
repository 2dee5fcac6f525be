"""Plots in the paper's form, and pictures of meshes with their holes circled."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from triquad_client import Mesh
from triquad_format.records.arrays import Doubles
from triquad_map.clusters import tight_boxes
from triquad_map.height_scale import HeightScale

from triquad_tools.evaluation.metrics import nearest_m
from triquad_tools.evaluation.shine_protocol import faces_inside
from triquad_tools.paper.published_figures import PublishedSet
from triquad_tools.paper.runs import MemoryAt, Run
from triquad_tools.plots.picture import BACKGROUND, draw_faces, view_along
from triquad_tools.recordings.cloud import thin

_DPI = 110
_COLOURS = {
    "triquad": "#0072b2",
    "as published": "#009e73",
    "VDBFusion": "#d55e00",
    "Open3D": "#e69f00",
    "SHINE-Mapping": "#cc79a7",
    "3QFP": "#009e73",
}
_HOLE_VOXEL_M = 0.4  # missing surface that is nearer than twice this is one hole
_LONGEST_VOXELS = 12  # a longer one counts as several
_LEAST_HOLE_M2 = 1.0
_MOST_HOLES = 12  # are circled in a picture: the largest
_CIRCLE = "#e8002a"


@dataclass(frozen=True)
class Pictured:
    """A mesh that is pictured."""

    run: Run
    mesh: Mesh


def plot_sparse(runs: Sequence[Run], published: PublishedSet, path: Path) -> None:
    """Plot ratios and parameters of whole runs against n; published ones are dashed."""
    figure = Figure((13, 4), _DPI, layout="constrained")
    completion, accuracy, parameters = figure.subplots(1, 3)
    for method in dict.fromkeys(run.method for run in runs):
        own = [run for run in runs if run.method == method]
        ns = [run.every for run in own]
        style = {"color": _COLOURS[method], "marker": "o", "label": f"{method}, measured here"}
        completion.plot(ns, [100 * run.scores.completion_ratio for run in own], **style)
        accuracy.plot(ns, [100 * run.scores.accuracy_ratio for run in own], **style)
        if all(run.parameters for run in own):
            parameters.plot(ns, [(run.parameters or 0) / 1e6 for run in own], **style)
    for name, ratios in published.completion_percent.items():
        style = {"color": _COLOURS[name], "ls": "--", "label": f"{name}, published, other data"}
        completion.plot(published.every, ratios, **style)
    _label(completion, "completion ratio in %")
    _label(accuracy, "accuracy ratio in %")
    _label(parameters, "learnable parameters in millions")
    parameters.set_ylim(bottom=0)
    figure.savefig(path)


def plot_memory(points: Sequence[MemoryAt], path: Path) -> None:
    """Plot parameters, bytes of the file and memory against the number of scans."""
    figure = Figure((13, 3.6), _DPI, layout="constrained")
    scans = [point.scans for point in points]
    values: list[tuple[str, Callable[[MemoryAt], float]]] = [
        ("learnable parameters in millions", lambda point: point.parameters / 1e6),
        ("map file in MB", lambda point: point.file_bytes / 1e6),
        ("memory of the map in MB", lambda point: point.memory_bytes / 1e6),
    ]
    for axes, (name, value) in zip(figure.subplots(1, 3), values, strict=True):
        axes.plot(scans, [value(point) for point in points], marker="o", color=_COLOURS["triquad"])
        axes.set(xlabel="scans", ylabel=name)
        axes.set_ylim(bottom=0)
    figure.savefig(path)


def picture_holes(
    pictured: Sequence[Pictured], truth: Doubles, threshold_m: float, path: Path
) -> None:
    """Save meshes in the truth's box, from one side, with circles around surface that they lack.

    Args:
        pictured: the meshes.
        truth: [M, 3] true surface points, metres.
        threshold_m: surface that is farther than twice this from a mesh is a hole.
        path: of the picture.
    """
    few = thin(truth, threshold_m)
    shown = pictured[0].mesh
    view = view_along(few, shown.vertices[faces_inside(shown, truth, threshold_m)])
    heights = HeightScale.around(few[:, 2])
    figure = Figure((13, 5.5 * -(-len(pictured) // 2)), _DPI, layout="constrained")
    places = figure.subplots(-(-len(pictured) // 2), 2, squeeze=False).ravel()
    for axes in places[len(pictured) :]:
        axes.set_visible(False)
    for axes, one in zip(places, pictured, strict=False):
        mesh, run = one.mesh, one.run
        axes.set(xticks=[], yticks=[], facecolor=BACKGROUND)
        axes.spines[:].set_visible(False)
        faces = faces_inside(mesh, truth, threshold_m)
        if not len(faces):
            axes.set_title(f"{run.method}, n = {run.every}: no surface", loc="left", fontsize=10)
            continue
        draw_faces(axes, view, mesh.vertices, faces, heights.colours(mesh.vertices[:, 2]))
        holes = _holes(mesh, few, 2 * threshold_m)
        for hole in holes:
            at = hole @ view.T
            middle = 0.5 * (at.min(axis=0) + at.max(axis=0))
            radius = 0.5 + 0.5 * float(np.ptp(at[:, :2], axis=0).max())
            circle = Circle((middle[0], -middle[1]), radius, fill=False, color=_CIRCLE, lw=1.6)
            axes.add_patch(circle)
        told = f"{len(holes)} largest holes circled" if holes else "no hole of a square metre"
        axes.set_title(f"{run.method}, n = {run.every}: {told}", loc="left", fontsize=10)
    figure.savefig(path)


def _holes(mesh: Mesh, truth: Doubles, beyond_m: float) -> list[Doubles]:
    """Return the points [N, 3] of each hole: true surface that a mesh lacks, the largest first."""
    missing = truth[nearest_m(mesh.vertices, truth, beyond_m) >= beyond_m]
    if not len(missing):
        return []
    piece = tight_boxes(np.floor(missing / _HOLE_VOXEL_M).astype(np.int64), _LONGEST_VOXELS).box
    order = np.argsort(piece, kind="stable")
    parts = np.split(missing[order], np.cumsum(np.bincount(piece))[:-1])
    side_m = 0.5 * beyond_m  # of the truth's voxels
    large = [part for part in parts if len(part) * side_m**2 >= _LEAST_HOLE_M2]
    return sorted(large, key=len, reverse=True)[:_MOST_HOLES]


def _label(axes: Axes, name: str) -> None:
    axes.set(xlabel="n, of every n-th scan", ylabel=name)
    axes.legend(fontsize=7)
