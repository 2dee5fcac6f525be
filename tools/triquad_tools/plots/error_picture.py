"""Pictures of errors: a mesh coloured by its distance from the truth, a map's answers at points.

What is missing is orange, which is in no scale of blues; what lies beyond the scale has a colour of
its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray
from triquad_client import Mesh
from triquad_format.records.arrays import Bytes, Doubles
from triquad_format.records.status import Status
from triquad_map.height_scale import colours_between

from triquad_tools.console.command import ToolError
from triquad_tools.console.report import percent
from triquad_tools.evaluation.map_scores import WithheldAnswer, WithheldScores
from triquad_tools.evaluation.metrics import Comparison, is_scored, mean_or_nan
from triquad_tools.plots.camera import ParallelCamera
from triquad_tools.plots.framing import Framing, framed
from triquad_tools.plots.mesh_sheet import (
    HEIGHT,
    WIDTH,
    ColourBar,
    Heading,
    Legend,
    save_mesh_sheet,
)
from triquad_tools.plots.picture import DIRECTION_NOTE, outside_notes
from triquad_tools.plots.render import facing, render_mesh

MISSING = "#e69f00"
BEYOND = "#8b1a1a"
ERROR_STOPS: Doubles = np.array(
    [
        [0.755, 0.862, 0.941],
        [0.561, 0.732, 0.915],
        [0.387, 0.598, 0.870],
        [0.244, 0.461, 0.798],
        [0.149, 0.324, 0.695],
        [0.109, 0.189, 0.563],
        [0.094, 0.047, 0.406],
    ]
)
"""``[7, 3]`` sRGB, from no error to the greatest: of even steps in Oklab."""

_NOTHING = Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32))
_WITHHELD_HIGH_M = 0.2
_POINT_PIXELS = 2.5
_LEAST_POINT_M = 0.02
_SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) - 0.5
_SQUARE_FACES = np.array([[0, 2, 1], [0, 3, 2]], np.int32)  # towards one who has y downwards


@dataclass(frozen=True)
class _Points:
    """Points that are drawn as squares."""

    places: Doubles  # [N, 3] metres, map frame
    colours: Doubles  # [N, 3] sRGB


def draw_mesh_errors(heading: Heading, comparison: Comparison, path: Path) -> None:
    """Draw a mesh by its distance from the truth, and what of the truth it lacks.

    Raises:
        OSError: ``path`` cannot be written.
    """
    mesh, scores, settings = comparison.mesh, comparison.scores, comparison.settings
    scored = is_scored(mesh.vertices, comparison.truth.points, settings)
    distances_m = comparison.truth.distances(np.asarray(mesh.vertices[scored], np.float64))
    colours = np.zeros((len(mesh.vertices), 3))
    colours[scored] = error_colours(distances_m, settings.accuracy_cut_m)
    beyond = bool((distances_m > settings.accuracy_cut_m).any())
    bar = replace(
        _bar("mesh to truth, cm\n(line: threshold)", settings.accuracy_cut_m),
        above=f"{percent(scores.outlier_ratio)} more" if beyond else "",
        limit=100.0 * settings.threshold_m,
    )
    named = [(MISSING, f"no mesh:\n{percent(1.0 - scores.completion_ratio)}\nof the truth")]
    lacking = _Points(comparison.missing, _one_colour(MISSING, len(comparison.missing)))
    part = Mesh(mesh.vertices, mesh.faces[scored[mesh.faces].all(axis=1)])
    view = _framed(part, lacking.places)
    beside = 1.0 - len(part.faces) / max(len(mesh.faces), 1)
    notes = [DIRECTION_NOTE.format(view.looks_to), *outside_notes(view)]
    if beside:
        notes.append(f"beside the truth, not scored: {100.0 * beside:.2g} %")
    legend = Legend(heading, bar, [notes[0], "; ".join(notes[1:])], camera=view.camera, named=named)
    image = _rendered(part, colours, lacking, camera=view.camera)
    save_mesh_sheet(path, image, legend)


def draw_withheld(
    heading: Heading, answers: Sequence[WithheldAnswer], scores: WithheldScores, path: Path
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
    colours = error_colours(distances_m, _WITHHELD_HIGH_M)
    colours[unknown] = to_rgb(MISSING)
    more = mean_or_nan(~unknown & (distances_m > _WITHHELD_HIGH_M))
    bar = replace(
        _bar("map at the points:\n|distance| in cm", _WITHHELD_HIGH_M),
        above=f"{percent(more)} more" if more else "",
    )
    points = _Points(np.concatenate([answer.points for answer in answers]), colours)
    view = _framed(_NOTHING, points.places)
    named = [(MISSING, f"UNKNOWN:\n{percent(scores.unknown_ratio)}")]
    legend = Legend(heading, bar, outside_notes(view), camera=view.camera, named=named)
    image = _rendered(_NOTHING, np.empty((0, 3)), points, camera=view.camera)
    save_mesh_sheet(path, image, legend)


def error_colours(distances_m: NDArray[np.floating], high_m: float) -> Doubles:
    """Colours ``[N, 3]``, sRGB in [0, 1], of distances ``[N]``, the greatest ``high_m``."""
    colours = colours_between(ERROR_STOPS, np.asarray(distances_m, np.float64) / high_m)
    colours[distances_m > high_m] = to_rgb(BEYOND)
    return colours


def _bar(label: str, high_m: float) -> ColourBar:
    return ColourBar(label, ERROR_STOPS, low=0.0, high=100.0 * high_m, beyond=BEYOND)


def _one_colour(colour: str, count: int) -> Doubles:
    return np.tile(to_rgb(colour), (count, 1))


def _framed(mesh: Mesh, places: Doubles) -> Framing:
    """A camera for a mesh and points, which count as small level squares."""
    level = _squares(places, _LEAST_POINT_M * np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
    return framed(_joined(mesh, level), WIDTH / HEIGHT)


def _rendered(mesh: Mesh, colours: Doubles, points: _Points, camera: ParallelCamera) -> Bytes:
    """A mesh in the colours of its vertices, and points."""
    side_m = max(_POINT_PIXELS * camera.height_m / HEIGHT, _LEAST_POINT_M)
    squares = _squares(points.places, side_m * camera.axes[:2])
    shown = Mesh(mesh.vertices, mesh.faces[facing(mesh.vertices[mesh.faces], camera)])
    both = _joined(shown, squares)
    return render_mesh(
        both.vertices,
        both.faces,
        np.concatenate([colours, points.colours.repeat(len(_SQUARE), axis=0)]),
        camera=camera,
        width=WIDTH,
        height=HEIGHT,
        plain=len(squares.faces),
    )


def _squares(places: Doubles, sides: Doubles) -> Mesh:
    """Squares around places ``[N, 3]`` with sides ``[2, 3]``."""
    corners = places[:, None] + _SQUARE @ sides
    first = len(_SQUARE) * np.arange(len(places), dtype=np.int32)
    faces = first[:, None, None] + _SQUARE_FACES
    return Mesh(corners.reshape(-1, 3), faces.reshape(-1, 3))


def _joined(one: Mesh, other: Mesh) -> Mesh:
    faces = np.concatenate([one.faces, other.faces + np.int32(len(one.vertices))])
    return Mesh(np.concatenate([one.vertices, other.vertices]), faces)
