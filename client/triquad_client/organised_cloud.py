"""Organised clouds, in which a ray without a return has its place too."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from triquad_format.records.arrays import Doubles

from triquad_client.checks import real_numbers
from triquad_client.errors import NO_NUMBER, InvalidScanError


def empty_returns(cloud: ArrayLike, directions: ArrayLike) -> Doubles:
    """Return the rays of an organised cloud that met nothing, for ``publish_scan(no_return=)``.

    Use it only where the sensor leaves a point empty because its ray met nothing.

    Args:
        cloud: [rows, columns, 3] metres, sensor frame; a point that is empty is NaN or 0 0 0.
        directions: [rows, columns, 3] of the sensor's rays, sensor frame, whatever their length.

    Returns:
        Directions [M, 3] of the empty points, row by row.

    Raises:
        InvalidScanError: the two are not arrays of one shape.
    """
    points, rays = _organised("cloud", cloud), _organised("directions", directions)
    if points.shape != rays.shape:
        raise InvalidScanError(
            f"cloud is {list(points.shape)} and directions are {list(rays.shape)}: give the "
            "direction of each point's ray"
        )
    empty = np.isnan(points).any(axis=-1) | (points == 0).all(axis=-1)
    of_empty: Doubles = rays[empty]
    return of_empty


def _organised(name: str, values: ArrayLike) -> Doubles:
    """Return an array [rows, columns, 3] as float64; values that are not finite may be in it."""
    try:
        array = real_numbers(values).astype(np.float64, copy=False)
    except NO_NUMBER as error:
        raise InvalidScanError(f"{name}: not an array of real numbers: {error}") from error
    if array.ndim != 3 or array.shape[2] != 3:
        raise InvalidScanError(f"{name}: {list(array.shape)} is not [rows, columns, 3]")
    return array
