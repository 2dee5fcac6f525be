"""The regions that scans enter."""

import itertools
import math
from collections.abc import Collection

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import FieldSettings, RegionIndex

from triquad_server.intake.rays import ScanRays


def regions_between(
    corners: Doubles, field: FieldSettings, reach_m: float = 0.0
) -> tuple[range, range, range]:
    """Return the indices, along each axis, of regions whose cubes meet the box of points [N, 3].

    The box is ``reach_m`` larger on each side.
    """
    half, pitch = field.region_side_m / 2 + reach_m, field.region_pitch_m
    x, y, z = (
        range(math.floor((along.min() - half) / pitch) + 1, math.ceil((along.max() + half) / pitch))
        for along in np.ascontiguousarray(corners.T)  # each axis for itself, which is faster
    )
    return x, y, z


def regions_around(
    rays: ScanRays, there: Collection[RegionIndex], field: FieldSettings
) -> list[RegionIndex]:
    """Return regions whose cubes hold an end point or the sensor, and existing ones in between.

    Rays that met nothing, and the robot, make no region: they are recorded in existing ones.
    """
    half = field.region_side_m / 2
    points = np.concatenate([rays.ends, rays.origin[None]])
    axes = np.ascontiguousarray(points.T)
    around = list(itertools.product(*regions_between(points, field)))

    def holds_any(index: RegionIndex) -> bool:
        near = [
            np.abs(x - at) < half for x, at in zip(axes, field.region_centre(index), strict=True)
        ]
        return bool((near[0] & near[1] & near[2]).any())

    if len(around) > 1:
        around = [index for index in around if index in there or holds_any(index)]
    reached = regions_between(np.concatenate([points, rays.free_corners]), field)
    return around + [
        index
        for index in there
        if index not in around and all(map(range.__contains__, reached, index))
    ]
