"""A picture of what a map file holds: what was seen, and how well it fits."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from triquad_format.records import morton
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import BLOCK_VOXELS, FieldSettings
from triquad_format.records.region import MapRecord
from triquad_format.records.seen_space import owned_evidence
from triquad_map.height_scale import HeightScale
from triquad_map.record_view import open_view

from triquad_tools.console.report import centimetres
from triquad_tools.plots.plan import (
    ERRORS,
    FREE,
    HEIGHTS,
    Layer,
    Plan,
    PlanGrid,
    Scale,
    draw_layers,
    draw_values,
    save_sheet,
)

_MOST_SAMPLES = 500_000
_LEAST_RANGE_CM = 2.0  # of errors


def draw_map(title: str, record: MapRecord, path: Path) -> None:
    """Draw plans of a map's coverage and, where it has training samples, of its errors.

    Raises:
        OSError: ``path`` cannot be written.
    """
    surface, seen = seen_columns(record, surface_only=True), seen_columns(record)
    grid = PlanGrid.around(seen.middles, record.settings.leaf_m)
    plans = [Plan("Coverage", partial(_draw_coverage, grid, surface, seen))]
    errors = sample_errors(record)
    if len(errors.points):
        plans.append(_errors_plan(grid, errors, record.settings))
    save_sheet(path, title, grid, plans=plans)


@dataclass(frozen=True)
class Columns:
    """Upright columns of voxels, each within one block of evidence."""

    middles: Doubles  # [N, 2] metres, map frame
    tops: Doubles  # [N] height of the middle of the highest voxel, metres


def seen_columns(record: MapRecord, surface_only: bool = False) -> Columns:
    """Return the columns where rays ended or, unless ``surface_only``, which they passed."""
    settings, parts = record.settings, [np.empty((0, 3))]
    for region in record.regions:
        evidence = owned_evidence(settings, region)
        # A byte holds one column.
        octets = evidence.surface if surface_only else evidence.surface | evidence.free
        rows, numbers = np.nonzero(octets)
        x, y = np.divmod(numbers, BLOCK_VOXELS)
        top = np.log2(octets[rows, numbers], dtype=np.float32).astype(np.int64)
        voxels = morton.decode(evidence.codes, 3)[rows] * BLOCK_VOXELS + np.stack([x, y, top], 1)
        parts.append(settings.region_corner(region.index) + (voxels + 0.5) * settings.leaf_m)
    middles = np.concatenate(parts)
    return Columns(middles[:, :2], middles[:, 2])


def _draw_coverage(grid: PlanGrid, surface: Columns, seen: Columns, axes: Axes) -> None:
    draw_layers(axes, [Layer("only free space was seen", FREE, grid.marked(seen.middles))])
    heights = HeightScale.around(surface.tops)
    scale = Scale("height of the topmost surface in m", HEIGHTS, heights.low_m, heights.high_m)
    draw_values(axes, grid.statistic(surface.middles, surface.tops, "max"), scale)


@dataclass(frozen=True)
class SampleErrors:
    """Errors where rays end that are kept, and at replay samples near the surface."""

    points: Doubles  # [N, 3] metres, map frame
    errors_m: Doubles  # [N] |signed distance - label|


def sample_errors(record: MapRecord) -> SampleErrors:
    """Return errors where rays end, and at samples within half a leaf of the surface.

    If there are many, an even share of them is used.
    """
    points, labels = [np.empty((0, 3))], [np.empty(0)]
    for region in record.regions:
        if region.training is not None:
            training = region.training
            ends = training.rays.ends_m(record.settings)
            near = np.abs(training.sample_labels) <= record.settings.leaf_m / 2
            centre = record.settings.region_centre(region.index)
            points += [ends + centre, training.sample_points[near] + centre]
            labels += [np.zeros(len(ends)), training.sample_labels[near].astype(np.float64)]
    every = sum(map(len, points)) // _MOST_SAMPLES + 1
    asked = np.concatenate(points)[::every]
    answer = open_view(record).query(asked)
    return SampleErrors(asked, np.abs(answer.sdf - np.concatenate(labels)[::every]))


def _errors_plan(grid: PlanGrid, found: SampleErrors, settings: FieldSettings) -> Plan:
    """Return a plan of the mean error in each column."""
    cells = grid.statistic(found.points, 100 * found.errors_m, "mean")
    high = max(float(np.ceil(np.nanquantile(cells, 0.99))), _LEAST_RANGE_CM)
    scale = Scale("mean |signed distance - label| in cm", ERRORS, low=0.0, high=high)
    mean, p95 = found.errors_m.mean(), np.quantile(found.errors_m, 0.95)
    note = (
        f"mean {centimetres(mean)}, 95 % {centimetres(p95)} at {len(found.points):,} samples "
        f"within {100 * settings.leaf_m / 2:g} cm of the surface"
    )
    return Plan("Error at the training samples", lambda axes: draw_values(axes, cells, scale), note)
