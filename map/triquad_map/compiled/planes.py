"""Planes through points, by the moments of these.

The moments [10] of points are their number and the sums of x, y, z, xx, xy, xz, yy, yz and zz.
"""

import numpy as np
from triquad_format.records.arrays import Doubles

from triquad_map.compiled.kernel import inner_kernel, kernel

MOMENTS = 10

_MIN_POINTS = 6
"""The fewest points that have a plane."""

_FLAT = 0.1
"""The share of an extent, a standard deviation, below which the next smaller one is none: a plane
has two extents, and no third. Greater: rounder things have normals, and fewer surfaces do."""

UNCLEAR, PLANE, ROUND = range(3)
"""The shape of points: too few to tell, or on a line; in a plane; in none."""


@kernel(inline="always")
def add_points(m: Doubles, at: tuple[float, float, float], count: float) -> None:
    """Add ``count`` points at one place to the moments ``m``."""
    a, b, c = at
    m[0] += count
    m[1] += count * a
    m[2] += count * b
    m[3] += count * c
    m[4] += count * a * a
    m[5] += count * a * b
    m[6] += count * a * c
    m[7] += count * b * b
    m[8] += count * b * c
    m[9] += count * c * c


@inner_kernel()
def fit_plane(m: Doubles | tuple[float, ...], normal: Doubles) -> int:
    """Return the shape of points with the moments ``m``; a plane's unit normal goes to ``normal``.

    It [3] has either sign, and the plane holds the mean of the points. Without a plane, it means
    nothing.
    """
    n = m[0]
    if n < _MIN_POINTS:
        return UNCLEAR
    mx, my, mz = m[1] / n, m[2] / n, m[3] / n
    xx, xy, xz = m[4] / n - mx * mx, m[5] / n - mx * my, m[6] / n - mx * mz
    yy, yz, zz = m[7] / n - my * my, m[8] / n - my * mz, m[9] / n - mz * mz
    # Eigenvalues of a symmetric 3 x 3 matrix (Smith 1961).
    mean = (xx + yy + zz) / 3
    off = xy * xy + xz * xz + yz * yz
    spread = np.sqrt(((xx - mean) ** 2 + (yy - mean) ** 2 + (zz - mean) ** 2 + 2 * off) / 6)
    if spread <= 1e-12:
        return UNCLEAR
    a, b, c = (xx - mean) / spread, (yy - mean) / spread, (zz - mean) / spread
    d, e, f = xy / spread, xz / spread, yz / spread
    half_det = (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)) / 2
    angle = np.arccos(min(1.0, max(-1.0, half_det))) / 3
    greatest = mean + 2 * spread * np.cos(angle)
    least = mean + 2 * spread * np.cos(angle + 2 * np.pi / 3)
    middle = 3 * mean - greatest - least
    if middle < _FLAT**2 * greatest:
        return UNCLEAR
    if least > _FLAT**2 * middle:
        return ROUND
    # The eigenvector is orthogonal to the rows of (A - least I): take their longest cross product.
    rows = ((xx - least, xy, xz), (xy, yy - least, yz), (xz, yz, zz - least))
    longest = 0.0
    for i in range(3):
        u, v = rows[i], rows[(i + 1) % 3]
        x, y, z = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
        squared = x * x + y * y + z * z
        if squared > longest:
            longest = squared
            normal[0], normal[1], normal[2] = x, y, z
    if longest == 0.0:
        return UNCLEAR
    normal /= np.sqrt(longest)
    return PLANE
