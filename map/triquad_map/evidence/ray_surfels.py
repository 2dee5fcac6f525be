"""Surface as the rays alone show it: normals, and the surfels of what the field has still to learn.

A normal is that of the plane of the ends in a voxel and those around it. A single scan does not
determine the normal of far ground, where it is a few lines of points; many scans do. So the plane
of a voxel is found again whenever twice as many scans have hit it.
"""

import numpy as np
from triquad_format.records.arrays import Bytes, Doubles, Floats, Ints, Longs

from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.evidence.observed import Observed, is_flat, row_of, rows_around, voxel_of
from triquad_map.evidence.seen_voxels import SeenVoxels
from triquad_map.surface import SurfelKind

MOMENTS = 10
"""Numbers of the moments of points: count, and sums of x, y, z, xx, xy, xz, yy, yz and zz."""

_MIN_POINTS = 6
"""The fewest points that have a plane."""

_FLAT = 0.1
"""The share of an extent, a standard deviation, below which the next smaller one is none: a plane
has two extents, and no third. Greater: rounder things have normals, and fewer surfaces do."""

UNCLEAR, PLANE, ROUND = range(3)
"""The shape of points: too few to tell, or on a line; in a plane; in none."""

_REACHES = (1.25, 2.25, 4.25)
"""How many voxels away ends count for a plane. Where those of the first are in none, those of the
second do; where these are too few or on a line, those of the third: leaves that are in no plane are
in none farther away, which halves the search on a real street with trees. Before any training, a
street at 16 beams is seen to 1.75 cm without the third, not 1.3; one with 5 cm of noise to 2.1 cm
if the second, too, were only for those that are too few or on a line, not 1.6."""

_ON_PLANE = 0.25
"""The height of a point over a plane above which it does not lie on it, in voxels."""

_RAY_DISC, _RAY_POINT = int(SurfelKind.RAY_DISC), int(SurfelKind.RAY_POINT)


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


@inner_kernel()
def find_normal(
    row: int, reach: float, since: int, seen: SeenVoxels, observed: Observed, found: Doubles
) -> int:
    """Return the shape of the ends within ``reach`` voxels of a row's, and its normal if a plane.

    They count as if all of a voxel lay in their middle, which leaves out most of their noise.
    Where a voxel was first hit in scan ``since`` or later, only ends in others of that kind do: not
    those on the floor, on which something was put.
    """
    moments = np.zeros(MOMENTS)
    here = observed.voxels[row].mean
    first = min(since, observed.voxels[row].first_scan)
    x, y, z = voxel_of(row, seen, observed)
    for near in rows_around(row, int(reach), seen, observed):
        other = observed.voxels[near]
        if other.ends > 0 and other.first_scan >= first:
            i, j, k = voxel_of(np.int64(near), seen, observed)
            mean = other.mean
            at = (i - x + mean[0], j - y + mean[1], k - z + mean[2])
            square = (at[0] - here[0]) ** 2 + (at[1] - here[1]) ** 2 + (at[2] - here[2]) ** 2
            if square <= reach * reach:
                add_points(moments, at, other.ends)
    shape = fit_plane(moments, found)
    if shape != PLANE:
        return shape
    height = 0.0
    for axis in range(3):
        height += (here[axis] - moments[1 + axis] / moments[0]) * found[axis]
    return PLANE if abs(height) <= _ON_PLANE else UNCLEAR  # a drop may hang over the ground


@kernel()
def fit_normals(
    rows: Ints, since: int, seen: SeenVoxels, observed: Observed, normals: Floats
) -> None:
    """Find the normals [N, 3] of the surface in the voxels of ``rows`` [N]; 0: not known.

    See :func:`find_normal`.
    """
    near, farther, farthest = _REACHES
    normal = np.zeros(3)
    for i, number in enumerate(rows):
        row = np.int64(number)
        shape = find_normal(row, near, since, seen, observed, normal)
        if shape != PLANE:
            shape = find_normal(row, farther, since, seen, observed, normal)
        if shape == UNCLEAR:
            shape = find_normal(row, farthest, since, seen, observed, normal)
        for axis in range(3):
            normals[i, axis] = normal[axis] if shape == PLANE else 0.0


class NormalSearch:
    """The search for normals that a scan has outdated, in the evidence as its ends left it.

    Rays may carve meanwhile: they add blocks, in which nothing ended, and move no end.
    """

    def __init__(self, rows: Ints, since: int, seen: SeenVoxels, observed: Observed) -> None:
        """Find which are outdated, of the voxels in ``rows`` [N]; blocks of ``seen`` are frozen."""
        found = outdated(rows, observed)
        # Block by block, what is read around one is at hand for the next: in a fifth to a third
        # less time.
        self.rows = found[np.argsort(observed.voxels["owner"][found])]
        self._normals = np.zeros((len(self.rows), 3), np.float32)
        self._since, self._seen, self._observed = since, seen, observed

    def find(self, first: int, last: int) -> None:
        """Find those of ``rows[first:last]``."""
        part = slice(first, last)
        fit_normals(self.rows[part], self._since, self._seen, self._observed, self._normals[part])

    def finish(self) -> None:
        """Record what was found."""
        self._observed.voxels["normal"][self.rows] = self._normals


@kernel()
def outdated(rows: Ints, observed: Observed) -> Ints:
    """Return those of the ``rows`` [N] whose normals are to be found again, each once."""
    found = np.empty(len(rows), np.int32)
    count = 0
    for row in rows:
        scans = observed.voxels[row].scans
        if row != 0 and scans & (scans - 1) == 0:
            found[count] = row
            count += 1
    return np.unique(found[:count])


@kernel()
def normals_at(ends: Doubles, rows: Ints, observed: Observed) -> Doubles:
    """Return the normals [N, 3] of the surface at ``ends`` [N, 3], voxels; NaN: not known.

    ``rows`` [N] are those of their voxels.
    """
    normals = np.full(ends.shape, np.nan)
    for i, row in enumerate(rows):
        voxel = observed.voxels[row]
        if row == 0 or not is_flat(voxel):
            continue
        height = 0.0
        for axis in range(3):
            place = ends[i, axis] - np.floor(ends[i, axis])
            height += (place - voxel.mean[axis]) * voxel.normal[axis]
        if abs(height) <= _ON_PLANE:
            for axis in range(3):
                normals[i, axis] = voxel.normal[axis]
    return normals


@inner_kernel()
def _set_normal(
    row: int, since: int, seen: SeenVoxels, observed: Observed, normal: Doubles
) -> bool:
    """Set the normal of the surface in a voxel, to the sensor; False: it is the way there."""
    voxel = observed.voxels[row]
    towards = voxel.towards
    for axis in range(3):
        normal[axis] = voxel.normal[axis]
    # Others may have ended around since its own was looked for.
    is_known = is_flat(voxel)
    if not is_known:
        is_known = find_normal(row, _REACHES[0], since, seen, observed, normal) == PLANE
    if not is_known:
        length = max(np.sqrt(_product(towards, towards)), 1e-6)
        for axis in range(3):
            normal[axis] = towards[axis] / length
        return False
    if _product(normal, towards) < 0:
        for axis in range(3):
            normal[axis] = -normal[axis]
    return True


@inner_kernel()
def _product(one: Floats | Doubles, other: Floats) -> float:
    """Return the scalar product of two vectors [3]."""
    product: float = one[0] * other[0] + one[1] * other[1] + one[2] * other[2]
    return product


@kernel()
def put_ray_surfels(
    voxels: Longs,
    since: int,
    hit_since: int,
    seen: SeenVoxels,
    observed: Observed,
    offsets: Floats,
    normals: Floats,
    kinds: Bytes,
) -> None:
    """Put in the surfels of ``voxels`` [N, 3] that rays alone show since scan ``since``.

    Where none ended since scan ``hit_since``, they stay as they are.
    """
    normal = np.zeros(3)
    for i in range(len(voxels)):
        row = row_of(seen, observed, voxels[i, 0], voxels[i, 1], voxels[i, 2])
        here = observed.voxels[row]
        if row == 0 or here.ends == 0 or here.first_scan < since or here.hit_scan < hit_since:
            continue
        is_disc = _set_normal(row, since, seen, observed, normal)
        kinds[i] = _RAY_DISC if is_disc else _RAY_POINT
        offsets[i], normals[i] = here.mean - np.float32(0.5), normal
