"""Finds which regions a scan reaches."""

import itertools
import math
from collections.abc import Collection

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import FieldSettings, RegionIndex

from triquad_server.intake.rays import ScanRays


def regions_around(
    rays: ScanRays, there: Collection[RegionIndex], field: FieldSettings
) -> list[RegionIndex]:
    """Return regions whose cubes hold an end point or the sensor, and existing ones in between.

    Rays that met nothing, and the robot, make no region: they are recorded in existing ones.
    """
    half = field.region_side_m / 2
    pitch = field.region_pitch_m

    def spanned(column: Doubles) -> range:
        low, high = column.min() - half, column.max() + half
        return range(math.floor(low / pitch) + 1, math.ceil(high / pitch))

    columns = [np.append(rays.ends[:, axis], rays.origin[axis]) for axis in range(3)]
    x, y, z = map(spanned, columns)
    around = list(itertools.product(x, y, z))

    def holds_any(index: RegionIndex) -> bool:
        near = [np.abs(column - i * pitch) < half for column, i in zip(columns, index, strict=True)]
        return bool((near[0] & near[1] & near[2]).any())

    if len(around) > 1:
        around = [index for index in around if index in there or holds_any(index)]
    free = rays.free_corners
    reached = [spanned(np.append(columns[axis], free[:, axis])) for axis in range(3)]
    return around + [
        index
        for index in there
        if index not in around and all(map(range.__contains__, reached, index))
    ]
