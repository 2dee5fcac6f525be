"""``triquad-bench --plot``: curves of what was measured, beside a neighbour measured on the same.

Published figures of 3QFP and SHINE-Mapping are of MaiCity and Newer College, those of VDBFusion,
too: other places, scored against clouds. They are not comparable, and not shown.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from triquad_tools.benchmarks.figures import CurvePoint, Figure
from triquad_tools.console.command import ToolError
from triquad_tools.plots.curves import STYLES, Curve, Panel, save_panels

TIME, BYTES, SPACING = "time", "bytes", "spacing"
F_SCORE, ACCURACY = "F-score at 10 cm", "error of the mesh, mean"


@dataclass(frozen=True)
class _Scored:
    """A curve's point of another system, and its scores there."""

    curve: str
    cost: float
    f_score: float  # percent, at 10 cm
    accuracy_cm: float


_NEIGHBOUR_STREET = 1
_NEIGHBOUR = (
    _Scored(TIME, 3.6, f_score=98.56, accuracy_cm=0.72),
    _Scored(BYTES, 32_252_355, f_score=98.56, accuracy_cm=0.72),
    _Scored(SPACING, 1, f_score=98.56, accuracy_cm=0.72),
    _Scored(SPACING, 2, f_score=97.18, accuracy_cm=0.78),
    _Scored(SPACING, 5, f_score=92.59, accuracy_cm=0.89),
    _Scored(SPACING, 10, f_score=80.32, accuracy_cm=0.98),
)
"""VDBFusion 0.1.6 on the scans of street 1, its meshes scored like all others:
``docs/benchmarks.md`` has the program."""


class _Axis(NamedTuple):
    """What a curve is drawn along."""

    label: str
    ticks: Sequence[float]
    scale: float = 1.0  # from costs to what is shown


_AXES = {
    TIME: _Axis("processor seconds", (1, 2, 5, 10, 20, 50)),
    BYTES: _Axis("file, MB", (0.5, 1, 2, 5, 10, 20, 50), 1e-6),
    SPACING: _Axis("one scan in so many", (1, 2, 5, 10)),
}
_UPWARDS = {F_SCORE: ("%", (None, 100.5)), ACCURACY: ("cm", (0.0, None))}
_HEADINGS = {
    TIME: "by time, taking in and training",
    BYTES: "by bytes, packed within errors",
    SPACING: "by scan spacing, 1.1 m and more",
}


@dataclass(frozen=True)
class Tradeoffs:
    """Figures along curves, of one street."""

    title: str
    street: int
    figures: Sequence[Figure]


def saved_tradeoffs(path: Path) -> Tradeoffs:
    """The curves in a file that ``triquad-bench --json`` wrote.

    Raises:
        ToolError: it is no such file, or has no curves.
        OSError: it cannot be read.
    """
    try:
        saved = json.loads(path.read_text(encoding="utf-8"))
        figures = [_figure(entry) for entry in saved["figures"] if entry.get("point") is not None]
        found = Tradeoffs(str(saved["title"]), int(saved["street"]), figures)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ToolError(f"{path}: is not what triquad-bench --json writes: {error!r}") from error
    if not figures:
        raise ToolError(f"{path}: has no curves: measure the part tradeoffs, with --json")
    return found


def draw_tradeoffs(found: Tradeoffs, path: Path) -> None:
    """Save a picture of the curves that there are.

    Raises:
        ToolError: there is none with all of its scores.
        OSError: it cannot be written.
    """
    curves = [name for name in _AXES if all(_points(found, name, score) for score in _UPWARDS)]
    if not curves:
        raise ToolError(f"{path}: no curve to draw: measure the part tradeoffs")
    rows = [[_panel(found, curve, measure) for curve in curves] for measure in _UPWARDS]
    notes = [
        f"Simulated street {found.street}: 110 m, 100 scans, noise of 1 cm. All meshes are scored",
        "against the exact surface: F at 10 cm, errors of what is nearer than 20 cm.",
        "3QFP and SHINE-Mapping published no figures on this street.",
    ]
    save_panels(path, f"triquad: {found.title}", rows, notes=notes)


def _panel(found: Tradeoffs, curve: str, measure: str) -> Panel:
    axis = _AXES[curve]
    points = _points(found, curve, measure)
    drawn = [Curve("triquad", STYLES[0], [(cost * axis.scale, value) for cost, value in points])]
    if found.street == _NEIGHBOUR_STREET:
        other = [
            (one.cost * axis.scale, one.f_score if measure == F_SCORE else one.accuracy_cm)
            for one in _NEIGHBOUR
            if one.curve == curve
        ]
        drawn.append(Curve("VDBFusion, voxels of 10 cm", STYLES[1], other))
    unit, limits = _UPWARDS[measure]
    lowest = min(cost for one in drawn for cost, _ in one.points)
    highest = max(cost for one in drawn for cost, _ in one.points)
    shown = [tick for tick in axis.ticks if 0.6 * lowest <= tick <= 1.6 * highest]
    heading = _HEADINGS[curve] if measure == F_SCORE else ""  # of its column
    return Panel(
        heading, axis.label, f"{measure}, {unit}", ticks=shown, limits=limits, curves=drawn
    )


def _points(found: Tradeoffs, curve: str, measure: str) -> list[tuple[float, float]]:
    """Costs and values of the figures on a curve."""
    return [
        (figure.point.cost, figure.value)
        for figure in found.figures
        if figure.point is not None
        and (figure.point.curve, figure.point.measure) == (curve, measure)
    ]


def _figure(entry: dict[str, Any]) -> Figure:
    point = CurvePoint(**entry["point"])
    if point.curve not in _AXES or not float(point.cost) > 0:
        raise ValueError(f"no curve of triquad-bench: {point}")
    value = math.nan if entry["value"] is None else float(entry["value"])  # JSON has no NaN
    return Figure(str(entry["name"]), value, str(entry["unit"]), point=point)
