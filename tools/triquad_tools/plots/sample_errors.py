"""How far a field is from the replay samples that it was taught."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.region import MapRecord, region_centre
from triquad_map.reference.evaluator import MapEvaluator

from triquad_tools.console.report import centimetres
from triquad_tools.plots.plan import Plan, PlanGrid, Scale, draw_nothing, draw_values

_MOST_SAMPLES = 500_000
_LEAST_RANGE_CM = 2.0


@dataclass(frozen=True)
class SampleErrors:
    """Errors at replay samples near the surface."""

    points: NDArray[np.float64]  # [N, 3] metres, map frame
    errors_m: NDArray[np.float64]  # [N] |signed distance - label|


def sample_errors(record: MapRecord) -> SampleErrors:
    """Errors at the samples within half a leaf of the surface, or at an even share of them."""
    points, labels = [np.empty((0, 3))], [np.empty(0)]
    for region in record.regions:
        if region.training is not None:
            near = np.abs(region.training.sample_labels) <= record.settings.leaf_m / 2
            centre = region_centre(record.settings, region.index)
            points.append(region.training.sample_points[near] + centre)
            labels.append(region.training.sample_labels[near].astype(np.float64))
    every = sum(map(len, points)) // _MOST_SAMPLES + 1
    asked = np.concatenate(points)[::every]
    answer = MapEvaluator(record).query(asked)
    return SampleErrors(asked, np.abs(answer.sdf - np.concatenate(labels)[::every]))


def errors_plan(grid: PlanGrid, record: MapRecord) -> Plan:
    """A plan of the mean error in each column."""
    heading = "Error at the training samples"
    found = sample_errors(record)
    if not len(found.points):
        return Plan(heading, lambda axes: draw_nothing(axes, "no samples in this file"))
    cells = grid.statistic(found.points, 100 * found.errors_m, "mean")
    high = max(float(np.ceil(np.nanquantile(cells, 0.99))), _LEAST_RANGE_CM)
    scale = Scale("mean |signed distance - label| in cm", "plasma_r", 0.0, high)
    mean, p95 = found.errors_m.mean(), np.quantile(found.errors_m, 0.95)
    note = (
        f"mean {centimetres(mean)}, 95 % {centimetres(p95)} at {len(found.points):,} samples "
        f"within {100 * record.settings.leaf_m / 2:g} cm of the surface"
    )
    return Plan(heading, lambda axes: draw_values(axes, cells, scale), note)
