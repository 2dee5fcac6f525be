"""Convex solids and their exact signed distances.

Distances are metres, positive outside a solid and negative inside.
"""

import math
from dataclasses import dataclass

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_map.compiled.kernel import inner_kernel

Vector = tuple[float, float, float]

_COLUMNS = 11
_KIND, X, Y, Z, _COS, _SIN, _A, _B, _C, _D, BOUND = range(_COLUMNS)

HALF_SPACE, BOX, CYLINDER, GABLE = range(4)

Distance = tuple[float, float, float, float]  # and its gradient


@dataclass(frozen=True)
class Solid:
    """One convex solid; made by the functions below."""

    kind: int
    centre: Vector  # metres, world frame; of the bounding sphere
    yaw: float  # radians, about z
    size: tuple[float, float, float, float]  # metres; the meaning depends on the kind
    bound_m: float  # radius of the bounding sphere


def half_space(height_m: float) -> Solid:
    """Return all that lies below ``z = height_m``."""
    return Solid(HALF_SPACE, (0.0, 0.0, height_m), 0.0, (0.0,) * 4, math.inf)


def box(centre: Vector, half: Vector, yaw: float = 0.0, radius: float = 0.0) -> Solid:
    """Return a box with half sides ``half``, its edges rounded with ``radius`` within them."""
    if not 0.0 <= radius <= min(half):
        raise ValueError(f"radius {radius!r} does not fit a box of half sides {half!r}")
    core = (half[0] - radius, half[1] - radius, half[2] - radius)
    return Solid(BOX, centre, yaw, (*core, radius), math.hypot(*core) + radius)


def sphere(centre: Vector, radius: float) -> Solid:
    """Return a ball: a box that is nothing but rounding."""
    return box(centre, (radius, radius, radius), 0.0, radius)


def cylinder(centre: Vector, radius: float, half_height: float) -> Solid:
    """Return a vertical cylinder with flat caps."""
    size = (radius, half_height, 0.0, 0.0)
    return Solid(CYLINDER, centre, 0.0, size, math.hypot(radius, half_height))


def gable(centre: Vector, half: Vector, eave: float, yaw: float = 0.0) -> Solid:
    """Return a house with a pitched roof: a box of half sides ``half`` cut by two slopes.

    The ridge runs along the local x axis at the top of the box; the slopes begin at height
    ``eave`` above its bottom.
    """
    if not 0.0 < eave < 2.0 * half[2]:
        raise ValueError(f"eave {eave!r} is not between 0 and the full height {2 * half[2]!r}")
    return Solid(GABLE, centre, yaw, (*half, eave), math.hypot(*half))


def solid_table(solids: tuple[Solid, ...]) -> Doubles:
    """Return the table ``[S, 11]`` of solids that the kernels read."""
    rows = [
        (one.kind, *one.centre, math.cos(one.yaw), math.sin(one.yaw), *one.size, one.bound_m)
        for one in solids
    ]
    return np.array(rows, np.float64).reshape(-1, _COLUMNS)


@inner_kernel()
def _box_distance(row: Doubles, x: float, y: float, z: float) -> Distance:
    qx, qy, qz = abs(x) - row[_A], abs(y) - row[_B], abs(z) - row[_C]
    sx, sy, sz = math.copysign(1.0, x), math.copysign(1.0, y), math.copysign(1.0, z)
    if qx <= 0.0 and qy <= 0.0 and qz <= 0.0:
        if qx >= qy and qx >= qz:
            return qx - row[_D], sx, 0.0, 0.0
        if qy >= qz:
            return qy - row[_D], 0.0, sy, 0.0
        return qz - row[_D], 0.0, 0.0, sz
    mx, my, mz = max(qx, 0.0), max(qy, 0.0), max(qz, 0.0)
    length = math.sqrt(mx * mx + my * my + mz * mz)
    return length - row[_D], sx * mx / length, sy * my / length, sz * mz / length


@inner_kernel()
def _extrude(profile: float, along: float) -> tuple[float, float, float]:
    """Return the distance to a profile extruded along an axis, and its partial derivatives."""
    if profile <= 0.0 and along <= 0.0:
        return (profile, 1.0, 0.0) if profile >= along else (along, 0.0, 1.0)
    mp, ma = max(profile, 0.0), max(along, 0.0)
    length = math.sqrt(mp * mp + ma * ma)
    return length, mp / length, ma / length


@inner_kernel()
def _cylinder_distance(row: Doubles, x: float, y: float, z: float) -> Distance:
    rho = math.sqrt(x * x + y * y)
    distance, wr, wz = _extrude(rho - row[_A], abs(z) - row[_B])
    ux, uy = (x / rho, y / rho) if rho > 0.0 else (1.0, 0.0)
    return distance, wr * ux, wr * uy, math.copysign(wz, z)


@inner_kernel()
def _gable_profile(row: Doubles, y: float, z: float) -> tuple[float, float, float]:
    """Return distance to the right half of a gable's outline (``y >= 0``, ``z`` from below)."""
    width, ridge, eave = row[_B], 2.0 * row[_C], row[_D]
    slope = math.sqrt(width * width + (ridge - eave) * (ridge - eave))
    ny, nz = (ridge - eave) / slope, width / slope  # normal of the roof
    bottom, wall, roof = -z, y - width, ny * y + nz * (z - ridge)
    if bottom <= 0.0 and wall <= 0.0 and roof <= 0.0:
        if bottom >= wall and bottom >= roof:
            return bottom, 0.0, -1.0
        return (wall, 1.0, 0.0) if wall >= roof else (roof, ny, nz)
    # Nearest points on the three edges of the half outline; the fold at y = 0 is no edge.
    best, by, bz = math.inf, 0.0, 0.0
    along = min(max((nz * y - ny * (z - ridge)) / slope, 0.0), 1.0)
    for ey, ez in (
        (min(max(y, 0.0), width), 0.0),
        (width, min(max(z, 0.0), eave)),
        (along * width, ridge - along * (ridge - eave)),
    ):
        gap = math.sqrt((y - ey) ** 2 + (z - ez) ** 2)
        if gap < best:
            best, by, bz = gap, y - ey, z - ez
    return (best, by / best, bz / best) if best > 0.0 else (0.0, ny, nz)


@inner_kernel()
def _gable_distance(row: Doubles, x: float, y: float, z: float) -> Distance:
    profile, gy, gz = _gable_profile(row, abs(y), z + row[_C])
    distance, wp, wx = _extrude(profile, abs(x) - row[_A])
    return distance, math.copysign(wx, x), math.copysign(wp * gy, y), wp * gz


@inner_kernel()
def distance_to(row: Doubles, x: float, y: float, z: float) -> Distance:
    """Return a world point's signed distance to a row's solid, and its gradient, world frame."""
    kind = row[_KIND]
    if kind == HALF_SPACE:
        return z - row[Z], 0.0, 0.0, 1.0
    dx, dy, dz = x - row[X], y - row[Y], z - row[Z]
    cos, sin = row[_COS], row[_SIN]
    lx, ly = cos * dx + sin * dy, cos * dy - sin * dx
    if kind == BOX:
        distance, gx, gy, gz = _box_distance(row, lx, ly, dz)
    elif kind == CYLINDER:
        distance, gx, gy, gz = _cylinder_distance(row, lx, ly, dz)
    else:
        distance, gx, gy, gz = _gable_distance(row, lx, ly, dz)
    return distance, cos * gx - sin * gy, sin * gx + cos * gy, gz
