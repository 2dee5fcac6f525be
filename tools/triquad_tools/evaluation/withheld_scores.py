"""Scores of a map at scans that were withheld from it; ``docs/tools.md`` defines every figure."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_client import SdfResult
from triquad_format.records.arrays import Doubles
from triquad_format.records.status import Status
from triquad_map.view import FieldAnswer

from triquad_tools.evaluation.metrics import mean_or_nan

MapQuery = Callable[[Doubles], SdfResult | FieldAnswer]
"""Asks a map, of a file or of a server, at points ``[N, 3]``, metres, map frame."""


@dataclass(frozen=True)
class WithheldScores:
    """The scores of a map where withheld scans hit something; NaN without points."""

    points: int
    surface_ratio: float  # share with status SURFACE
    unknown_ratio: float  # share with status UNKNOWN
    sdf_median_m: float  # of the magnitude, over all points
    sdf_p90_m: float
    surface_sdf_median_m: float  # the same over the points with status SURFACE
    surface_sdf_p90_m: float


def score_withheld(query: MapQuery, clouds: Iterable[Doubles]) -> WithheldScores:
    """Return scores of a map at the points ``[N, 3]``, map frame, of scans that it never saw."""
    distances = [np.empty(0, np.float32)]
    statuses = [np.empty(0, np.uint8)]
    for cloud in clouds:
        answer = query(cloud)
        distances.append(np.nan_to_num(np.abs(answer.sdf), nan=np.inf))
        statuses.append(answer.status)
    distance, status = np.concatenate(distances), np.concatenate(statuses)
    on_surface = distance[status == Status.SURFACE]
    return WithheldScores(
        points=len(distance),
        surface_ratio=mean_or_nan(status == Status.SURFACE),
        unknown_ratio=mean_or_nan(status == Status.UNKNOWN),
        sdf_median_m=_quantile(distance, 0.5),
        sdf_p90_m=_quantile(distance, 0.9),
        surface_sdf_median_m=_quantile(on_surface, 0.5),
        surface_sdf_p90_m=_quantile(on_surface, 0.9),
    )


def _quantile(values: NDArray[np.floating], level: float) -> float:
    # "lower" never blends with an infinite neighbour.
    return float(np.quantile(values, level, method="lower")) if len(values) else float("nan")
