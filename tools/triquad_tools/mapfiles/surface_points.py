"""Points on the surface of a map."""

import math

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.region import MapRecord
from triquad_format.records.status import Status
from triquad_map.reference.evaluator import MapEvaluator

from triquad_tools.mapfiles.seen_space import surface_voxels

NEAR_ENOUGH_M = 1e-4
"""A point this near to the zero of the field is on the surface."""

_STEPS = 8
_LEAST_SLOPE = 0.1  # a flatter field says nothing of where its zero is


def surface_points(record: MapRecord) -> NDArray[np.float64]:
    """Points ``[N, 3]`` where the field is zero, at most one for each voxel where rays ended.

    The middles of these voxels are moved along the gradient by Newton's method. Those that have
    not come to a zero within a voxel's diagonal, at which the map says ``SURFACE``, are left out.
    """
    evaluator = MapEvaluator(record)
    leaf_m = record.settings.leaf_m
    middles = surface_voxels(record)
    points = middles.copy()
    arrived = np.zeros(len(points), np.bool_)
    under_way = np.arange(len(points))
    for _ in range(_STEPS):
        answer = evaluator.query(points[under_way], gradient=True)
        assert answer.gradient is not None
        there = np.abs(answer.sdf) <= NEAR_ENOUGH_M
        arrived[under_way[there & (answer.status == Status.SURFACE)]] = True
        steps = _newton_steps(answer.sdf[~there], answer.gradient[~there], leaf_m / 2)
        under_way = under_way[~there]
        points[under_way] += steps
        distance = np.linalg.norm(points[under_way] - middles[under_way], axis=1)
        under_way = under_way[distance <= math.sqrt(3) * leaf_m]
    found: NDArray[np.float64] = points[arrived]
    return found


def _newton_steps(
    sdf: NDArray[np.float32], gradient: NDArray[np.float32], longest_m: float
) -> NDArray[np.float64]:
    """Steps ``[N, 3]`` towards the zero, metres, none longer than ``longest_m``."""
    slope = np.maximum(np.linalg.norm(gradient, axis=1), _LEAST_SLOPE)
    length = np.minimum(np.abs(sdf) / slope, longest_m)
    steps: NDArray[np.float64] = (-np.sign(sdf) * length / slope)[:, None] * gradient
    return steps
