"""Surface as the rays alone show it: normals, and the surfels of what the field has still to learn.

A normal is that of the plane of the ends in a voxel and those around it. A single scan does not
determine the normal of far ground, where it is a few lines of points; many scans do. So the plane
of a voxel is found again whenever twice as many scans have hit it.
"""

import numpy as np
from triquad_format.records.arrays import Bytes, Doubles, Floats, Ints, Longs

from triquad_map.compiled.kernel import inner_kernel, kernel
from triquad_map.compiled.planes import MOMENTS, PLANE, UNCLEAR, add_points, fit_plane
from triquad_map.evidence.observed import Observed, is_flat, row_of, rows_around, voxel_of
from triquad_map.evidence.seen_voxels import SeenVoxels
from triquad_map.surface import SurfelKind

_REACHES = (1.25, 2.25, 4.25)
"""How many voxels away ends count for a plane. Where those of the first are in none, those of the
second do; where these are too few or on a line, those of the third: leaves that are in no plane are
in none farther away, which halves the search on a real street with trees. Before any training, a
street at 16 beams is seen to 1.75 cm without the third, not 1.3; one with 5 cm of noise to 2.1 cm
if the second, too, were only for those that are too few or on a line, not 1.6."""

_ON_PLANE = 0.25
"""The height of a point over a plane above which it does not lie on it, in voxels."""

_RAY_DISC, _RAY_POINT = int(SurfelKind.RAY_DISC), int(SurfelKind.RAY_POINT)


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
